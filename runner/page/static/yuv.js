/** Converts pixels of a frame (I420 or NV12, as decoders output them) to RGBA, without any browser function. */

const SHIFT = 14;
const MARGIN = 512; // how far a sum may exceed 0..255 on either side
const OPAQUE = 0xff << 24;
const CLAMP = Uint8Array.from({ length: 256 + 2 * MARGIN }, (_, i) => Math.min(255, Math.max(0, i - MARGIN)));
const LUMA = { bt709: [0.2126, 0.0722], smpte170m: [0.299, 0.114], bt470bg: [0.299, 0.114] }; // weights of red and blue
const tables = new Map();

/** Look-up tables of a colour space: one addition for each component of a pixel. @param {VideoColorSpaceInit} space */
function tablesOf({ matrix, fullRange }) {
  const key = `${matrix} ${fullRange}`;
  if (!tables.has(key)) tables.set(key, makeTables(LUMA[matrix] ?? LUMA.smpte170m, fullRange));
  return tables.get(key);
}

function makeTables([red, blue], full) {
  const [black, span, chroma] = full ? [0, 255, 255] : [16, 219, 224];
  const green = 1 - red - blue;
  const table = (of) => Int32Array.from({ length: 256 }, (_, i) => Math.round(of(i) * (1 << SHIFT)));
  const colour = (weight) => table((i) => (((i - 128) * 255) / chroma) * weight);
  return {
    y: table((i) => ((i - black) * 255) / span + MARGIN + 0.5),
    rv: colour(2 * (1 - red)),
    gv: colour((-2 * (1 - red) * red) / green),
    gu: colour((-2 * (1 - blue) * blue) / green),
    bu: colour(2 * (1 - blue)),
  };
}

/**
 * @param {Uint8Array} bytes of all planes  @param {{offset, stride}[]} planes as returned by VideoFrame.copyTo
 * @param {"I420"|"NV12"} format  @param {VideoColorSpaceInit} space
 * @param {ImageData} image output, of the frame's size, or half of it in each direction
 * @param {number} width of the frame
 */
export function toRgba(bytes, planes, format, space, image, width) {
  const chroma_step = format === "NV12" ? 2 : 1; // NV12 interleaves U and V
  const [y, u] = planes;
  const v = format === "NV12" ? { offset: u.offset + 1, stride: u.stride } : planes[2];
  const out = new Int32Array(image.data.buffer);
  const convert = image.width === width ? wholeRow : halfRow;
  const across = image.width === width ? 1 : 2;
  const lookUp = tablesOf(space);
  for (let row = 0; row < image.height; row++) {
    const chroma = across === 2 ? row : row >> 1;
    const [light, colour] = [y.offset + row * across * y.stride, chroma * u.stride];
    const from = { y: light, below: y.stride, u: u.offset + colour, v: v.offset + chroma * v.stride };
    convert(bytes, from, chroma_step, lookUp, out, row * image.width, image.width);
  }
}

/**
 * Fill an image with another one, stretched; without smoothing, which would take several times as long.
 * @template {{width: number, height: number, data: Uint8ClampedArray}} I
 * @param {I} from  @param {I} to
 * @returns {I} `to`
 */
export function scaled(from, to) {
  const [pixels, out] = [from, to].map(({ data }) => new Uint32Array(data.buffer, data.byteOffset, data.length / 4));
  const columns = Uint32Array.from({ length: to.width }, (_, x) => ((x + 0.5) * from.width) / to.width);
  for (let y = 0; y < to.height; y++) {
    const row = from.width * Math.floor(((y + 0.5) * from.height) / to.height);
    for (let x = 0, at = y * to.width; x < to.width; x++, at++) out[at] = pixels[row + columns[x]];
  }
  return to;
}

/** One row of pixels; two neighbours share their chroma. */
function wholeRow(bytes, from, chroma_step, { y, rv, gv, gu, bu }, out, to, width) {
  let { y: ys, u: us, v: vs } = from;
  const end = to + width;
  while (to < end) {
    const cb = bytes[us];
    const cr = bytes[vs];
    const red = rv[cr];
    const green = gv[cr] + gu[cb];
    const blue = bu[cb];
    us += chroma_step;
    vs += chroma_step;
    for (const stop = to + 2 < end ? to + 2 : end; to < stop; to++) {
      const light = y[bytes[ys++]];
      out[to] = OPAQUE | (CLAMP[(light + blue) >> SHIFT] << 16) | (CLAMP[(light + green) >> SHIFT] << 8) | CLAMP[(light + red) >> SHIFT];
    }
  }
}

/** One row of pixels, each the mean of four that share their chroma anyway. */
function halfRow(bytes, from, chroma_step, { y, rv, gv, gu, bu }, out, to, width) {
  let { y: ys, u: us, v: vs } = from;
  let low = ys + from.below;
  for (const end = to + width; to < end; to++) {
    const light = y[(bytes[ys] + bytes[ys + 1] + bytes[low] + bytes[low + 1] + 2) >> 2];
    const cb = bytes[us];
    const cr = bytes[vs];
    ys += 2;
    low += 2;
    us += chroma_step;
    vs += chroma_step;
    const [red, green] = [CLAMP[(light + rv[cr]) >> SHIFT], CLAMP[(light + gv[cr] + gu[cb]) >> SHIFT]];
    out[to] = OPAQUE | (CLAMP[(light + bu[cb]) >> SHIFT] << 16) | (green << 8) | red;
  }
}
