// The data of the page: JSON, and arrays of 16-bit integers; see lagbench/board/encoding.py.
// First stand the lower bytes of all integers, then the upper ones; arrays of a kind stand together.

const MISSING_LEVEL = -32768;

// The digits of base 85, without those that mean something in HTML.
const DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%.()*+-;,=/?@^_`{|}~";

/** Return the bytes that a text encodes in base 85: five digits are four bytes; a shorter group ends the text. */
function bytesOf(text) {
  const places = new Uint8Array(128);
  for (let i = 0; i < DIGITS.length; i += 1) places[DIGITS.charCodeAt(i)] = i;
  const lacking = (5 - (text.length % 5)) % 5;
  const whole = text + DIGITS.at(-1).repeat(lacking);
  const view = new DataView(new ArrayBuffer((whole.length / 5) * 4));
  for (let i = 0; i < whole.length; i += 5) {
    let group = 0;
    for (let k = i; k < i + 5; k += 1) group = 85 * group + places[whole.charCodeAt(k)];
    view.setUint32((i / 5) * 4, group);
  }
  return new Uint8Array(view.buffer, 0, view.byteLength - lacking);
}

/** Return the bytes that an element holds, as gzip in base 85. */
async function bytesIn(id) {
  const compressed = bytesOf(document.getElementById(id).textContent);
  const stream = new Blob([compressed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

const [dataBytes, arrayBytes] = await Promise.all([bytesIn("page-data"), bytesIn("page-arrays")]);
const BOARD = JSON.parse(new TextDecoder().decode(dataBytes));
for (const tab of BOARD.tabs) tab.columns = tab.columns.map((place) => BOARD.columns[place]);
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

function readNumbers({ kind, start, rows, columns, zero, step, log }) {
  const first = BOARD.starts[kind] + start;
  const levels = Int16Array.from({ length: rows * columns }, (_, i) => storedAt(first + i));
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
