/**
 * A clock as a row of black and white cells, for a camera to film from a screen, and its decoding from the picture.
 * Only the low 18 bits of the time in ms are shown: it repeats after about four minutes. Pure.
 */

export const CYCLE_MS = 2 ** 18;
export const HEAD = [1, 1, 0, 1]; // 1: black; white margins on both sides
export const TAIL = [1, 0, 1, 1];
const BITS = 18;
const CHECK_BITS = 16;
export const CELLS = HEAD.length + BITS + CHECK_BITS + TAIL.length;
const ROWS = 48; // rows of a picture that are tried
const MIN_CONTRAST = 40; // between the darkest and the brightest pixel of a row, of 255
const MIN_CELL_PX = 2.5;
const HEAD_TOLERANCE = 0.25; // relative deviation of the first cells' width from the average
const MAX_EDGES = 200; // in a row; with more it shows something else

/** The cells of a time: head, bits from the highest one, their checksum, tail. */
export function cellsOf(ms) {
  const value = ((Math.floor(ms) % CYCLE_MS) + CYCLE_MS) % CYCLE_MS;
  return [...HEAD, ...bitsOf(value, BITS), ...bitsOf(checksum(value), CHECK_BITS), ...TAIL];
}

/** Time since the counter was shown, if it was shown less than a cycle ago, ms. */
export const elapsed = (counter, ms) => (((ms - counter) % CYCLE_MS) + CYCLE_MS) % CYCLE_MS;

/**
 * The counter in a picture, in ms within its cycle; null: none is readable.
 * @param {Uint8Array} luma from the first row on
 */
export function read(luma, width, height, stride) {
  const rows = Math.min(ROWS, height);
  for (let i = 0; i < rows; i++) {
    const from = Math.floor(((i + 0.5) * height) / rows) * stride;
    const found = readRow(luma.subarray(from, from + width));
    if (found !== null) return found;
  }
  return null;
}

function readRow(row) {
  const [darkest, brightest] = row.reduce(([low, high], y) => [Math.min(low, y), Math.max(high, y)], [255, 0]);
  if (brightest - darkest < MIN_CONTRAST) return null;
  const middle = (darkest + brightest) / 2;
  const edges = edgesOf(row, middle);
  if (edges.length > MAX_EDGES) return null;
  for (let i = 0; i + 1 < edges.length; i++) {
    if (!edges[i].black) continue;
    const first = edges[i + 1].x - edges[i].x; // two black cells
    for (let j = edges.length - 1; j > i; j--) {
      const cell = (edges[j].x - edges[i].x) / CELLS;
      if (cell < MIN_CELL_PX) break;
      if (edges[j].black || Math.abs(first / 2 - cell) > HEAD_TOLERANCE * cell) continue;
      const found = readCells(row, middle, edges[i].x, cell);
      if (found !== null) return found;
    }
  }
  return null;
}

/** The edges between black and white in a row, at subpixel positions. */
function edgesOf(row, middle) {
  const edges = [];
  for (let x = 1; x < row.length; x++) {
    const black = row[x] < middle;
    if (black === row[x - 1] < middle) continue;
    edges.push({ x: x - 1 + (middle - row[x - 1]) / (row[x] - row[x - 1]), black });
  }
  return edges;
}

function readCells(row, middle, from, cell) {
  const bit = (i) => Number(row[Math.round(from + (i + 0.5) * cell)] < middle);
  const end = CELLS - TAIL.length;
  if (!HEAD.every((black, i) => bit(i) === black) || !TAIL.every((black, i) => bit(end + i) === black)) return null;
  const number = (begin, count) => Array.from({ length: count }, (_, i) => bit(begin + i)).reduce((sum, b) => 2 * sum + b, 0);
  const value = number(HEAD.length, BITS);
  return checksum(value) === number(HEAD.length + BITS, CHECK_BITS) ? value : null;
}

const bitsOf = (value, count) => Array.from({ length: count }, (_, i) => (value >> (count - 1 - i)) & 1);

/** CRC-16/CCITT-FALSE of the three bytes of a value. */
function checksum(value) {
  let crc = 0xffff;
  for (const byte of [value >> 16, (value >> 8) & 0xff, value & 0xff]) {
    crc ^= byte << 8;
    for (let i = 0; i < 8; i++) crc = (crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1) & 0xffff;
  }
  return crc;
}
