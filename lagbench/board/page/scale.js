// Axes with round ticks, as lagbench/figures/chart.py has them.

const WIDE = 60;
const DEEPEST = 1e-6;

function makeScale(low, high, log, exponent, ticks) {
  const share = log
    ? (value) => (value > 0 ? Math.log10(value / low) / Math.log10(high / low) : NaN)
    : (value) => (value - low) / (high - low);
  return { low, high, log, ticks, share, factor: exponent ? `×${power(exponent)}` : "" };
}

function linear(low, high, { count = 5, tight = false } = {}) {
  if (!(high > low)) {
    const middle = Math.abs(low) || 1;
    [low, high] = [low - middle / 2, low + middle / 2];
  }
  const step = roundStep((high - low) / count);
  const first = Math.floor(low / step + 1e-9);
  const last = Math.ceil(high / step - 1e-9);
  let marks = Array.from({ length: last - first + 1 }, (_, k) => (first + k) * step);
  if (tight) marks = marks.filter((v) => v >= low - 1e-9 * step && v <= high + 1e-9 * step);
  else [low, high] = [marks[0], marks.at(-1)];
  const order = Math.floor(Math.log10(Math.max(Math.abs(low), Math.abs(high))));
  const exponent = order < -2 || order > 4 ? order : 0;
  const unit = 10 ** exponent;
  const labels = decimals(marks.map((v) => v / unit), step / unit);
  return makeScale(low, high, false, exponent, marks.map((value, i) => ({ value, label: labels[i] })));
}

function roundStep(rough) {
  const unit = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 2.5, 5, 10].map((factor) => factor * unit).find((step) => step >= rough * (1 - 1e-9));
}

function logarithmic(low, high) {
  const first = Math.floor(Math.log10(low) + 1e-9);
  const last = Math.max(Math.ceil(Math.log10(high) - 1e-9), first + 1);
  const every = 1 + Math.floor((last - first) / 7);
  const ticks = [];
  for (let k = first; k <= last; k += every) ticks.push({ value: 10 ** k, label: plainPower(k) });
  if (last - first <= 2) {
    for (let k = first; k < last; k += 1) {
      for (const factor of [2, 5]) ticks.push({ value: factor * 10 ** k, label: plainPower(k, factor) });
    }
  }
  return makeScale(10 ** first, 10 ** last, true, 0, ticks);
}

/** Return a power of ten, written out where that is short. */
function plainPower(exponent, factor = 1) {
  if (exponent >= -3 && exponent <= 4) return written(factor * 10 ** exponent, 1);
  return factor === 1 ? power(exponent) : `${factor}×${power(exponent)}`;
}

/** Return an axis for values, logarithmic where they are positive and span a wide range. */
function spanning(values, { zero = true, log = null } = {}) {
  const known = [...values].filter((v) => Number.isFinite(v) && Math.abs(v) < 1e300);
  if (!known.length) return linear(0, 1);
  const low = known.reduce((a, b) => Math.min(a, b));
  const high = known.reduce((a, b) => Math.max(a, b));
  const positive = known.filter((v) => v > DEEPEST * high).sort((a, b) => a - b);
  const usable = positive.length > 0 && high > 1e-300;
  const wanted = log ?? (low >= 0 && usable && positive[Math.floor(0.05 * positive.length)] * WIDE < high);
  if (wanted && usable) return logarithmic(positive[0], high);
  return linear(zero ? Math.min(low, 0) : low, zero ? Math.max(high, 0) : high);
}
