// The data of the page: JSON, and arrays of 16-bit integers; see lagbench/board/encoding.py.
// First stand the lower bytes of all integers, then the upper ones.

const MISSING_LEVEL = -32768;

/** Return the bytes that an element holds, as base64 of gzip. */
async function bytesIn(id) {
  const text = document.getElementById(id).textContent;
  const compressed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([compressed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

const [dataBytes, arrayBytes] = await Promise.all([bytesIn("page-data"), bytesIn("page-arrays")]);
const BOARD = JSON.parse(new TextDecoder().decode(dataBytes));
const STORED = new Uint8Array(arrayBytes);
const STORED_COUNT = STORED.length / 2;

/** Return a stored integer; 0, 1, 2, 3, 4 stand for 0, -1, 1, -2, 2. */
function storedAt(place) {
  const folded = STORED[place] + 256 * STORED[STORED_COUNT + place];
  return (folded >>> 1) ^ -(folded & 1);
}

/** Return the numbers of an array, row by row, NaN where missing; each array is read once. */
function numbersOf(array) {
  array.numbers ??= readNumbers(array);
  return array.numbers;
}

function readNumbers({ start, rows, columns, zero, step, log }) {
  const levels = Int16Array.from({ length: rows * columns }, (_, i) => storedAt(start + i));
  // Rows are stored as differences, which wrap around as the elements of an Int16Array do.
  for (let i = columns; i < levels.length; i += 1) levels[i] += levels[i - columns];
  return Float64Array.from(levels, (level) => {
    if (level === MISSING_LEVEL) return NaN;
    const value = zero + step * level;
    return log ? Math.exp(value) : value;
  });
}

/** Return frames, mean, lowest and highest values of a curve, of reference predictors the mean alone; null without a curve. */
function curveOf(curve) {
  if (!curve) return null;
  const frames = numbersOf(curve.frames);
  const values = numbersOf(curve.values);
  const { columns } = curve.values;
  const column = (k) => frames.map((_, i) => values[columns * i + k]);
  if (columns === 1) return { frames, mean: column(0) };
  return { frames, mean: column(0), low: column(1), high: column(2) };
}

function histogramOf({ low, high, shares }) {
  return { low, high, shares: numbersOf(shares) };
}
