// Packed arrays: two letters a number, twelve bits, films one letter; see lagbench/board/payload.py.

const BOARD = JSON.parse(document.getElementById("board").textContent);

const LEVELS = 4094;
const LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";
const PLACES = new Uint8Array(128);
[...LETTERS].forEach((letter, place) => { PLACES[letter.charCodeAt(0)] = place; });

/** Return the numbers of `[text, low, high, log]`, NaN where missing. */
function unpack([text, low, high, log]) {
  const values = new Float64Array(text.length / 2);
  for (let i = 0; i < values.length; i += 1) {
    const step = 64 * PLACES[text.charCodeAt(2 * i)] + PLACES[text.charCodeAt(2 * i + 1)];
    const share = step / LEVELS;
    if (step > LEVELS) values[i] = NaN;
    else values[i] = log ? low * (high / low) ** share : low + (high - low) * share;
  }
  return values;
}

/** Return positions of a film: its first frame as above, then what each coordinate does beside constant velocity. */
function unpackFilm([text, low, high, , count, reach]) {
  const start = unpack([text.slice(0, 2 * count), low, high, 0]);
  const values = new Float64Array(text.length - count);
  values.set(start);
  for (let i = count; i < values.length; i += 1) {
    const now = values[i - count];
    const before = i < 2 * count ? now : values[i - 2 * count];
    const steps = PLACES[text.charCodeAt(i + count)] - 31;
    values[i] = 2 * now - before + (reach * steps * Math.abs(steps)) / 961;
  }
  return values;
}

/** Return what a number in the payload refers to; arrays are unpacked once. */
function pooled(index) {
  const held = BOARD.pool[index];
  return typeof held[0] === "string" ? (unpacked[index] ??= (held[3] === 2 ? unpackFilm : unpack)(held)) : held;
}

const unpacked = [];

function curveOf(packed) {
  if (!packed) return null;
  const { frames, mean, low, high } = packed;
  return { frames: pooled(frames), mean: pooled(mean), low: pooled(low), high: pooled(high) };
}

function histogramOf([low, high, shares]) {
  return { low, high, shares: pooled(shares) };
}
