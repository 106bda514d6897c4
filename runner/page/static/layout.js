/**
 * Layout of the tiles: bands of rows, boxes in the aspect ratio of the full image. Those of portrait images are square,
 * since names and figures need room. Pure; lengths in px.
 *
 * A row without a spanning picture is a band of its own: its pictures are equally high and stand side by side. Rows that
 * spanning pictures join are a band with a grid, whose columns are equally wide and whose rows are equally high.
 */

export const GAP = 8;
const EVEN = 1.25; // a row is at most this many times as high as the highest row limited by the width
const LARGER = 1.4; // times the area, for which a row is broken
const MIN_HEIGHT = 24; // of a picture
const READABLE_PX = 300; // width of a tile on a narrow page

/** @typedef {{row: number, column: number, row_span: number, column_span: number}} Place */
/** @typedef {Record<string, Place|null>} Places by camera; null: none */
/** @typedef {{name: string, width: number, height: number}} Camera */
/** @typedef {{camera: Camera} & Place} Tile its place counts within the band, without rows and columns that no tile covers */
/** @typedef {{rows: number, columns: number, grid: boolean, tiles: Tile[]}} Band */

/**
 * The bands of a layout. Cameras without a place follow in rows of their own, as long as the longest row with places.
 * @param {Camera[]} cameras  @param {Places} places
 * @returns {Band[]}
 */
export function bandsOf(cameras, places) {
  const placed = cameras.flatMap((camera) => (places[camera.name] ? [{ camera, .../** @type {Place} */ (places[camera.name]) }] : []));
  const bands = joined(placed).map(bandOf);
  const others = cameras.filter(({ name }) => !places[name]);
  const longest = Math.max(...bands.map(({ columns }) => columns), others.length ? Math.ceil(Math.sqrt(others.length)) : 1);
  for (let i = 0; i < others.length; i += longest)
    bands.push(bandOf(others.slice(i, i + longest).map((camera, column) => ({ camera, row: 0, column, row_span: 1, column_span: 1 }))));
  return bands;
}

/**
 * The bands of a page that scrolls: rows of as many tiles as are wide enough to be read, in the order of a layout.
 * @param {Band[]} bands  @param {number} width of the area
 * @returns {Band[]}
 */
export function narrowBands(bands, width) {
  const cameras = bands.flatMap(({ tiles }) => tiles.map(({ camera }) => camera));
  const length = Math.max(1, Math.floor(width / READABLE_PX));
  const rows = Array.from({ length: Math.ceil(cameras.length / length) }, (_, i) => cameras.slice(i * length, (i + 1) * length));
  return rows.map((row) => bandOf(row.map((camera, column) => ({ camera, row: 0, column, row_span: 1, column_span: 1 }))));
}

/**
 * The bands with rows broken in two, or joined, wherever that makes the pictures much larger, in an area as of `heightsOf`:
 * three wide pictures side by side leave most of a window empty, and so does one above another above three.
 * @param {Band[]} bands  @param {number} width  @param {number} height  @param {number} chrome
 * @returns {Band[]}
 */
export function spreadBands(bands, width, height, chrome) {
  const shown = (some) => shownArea(some, width, height, chrome);
  const rows = bands.filter(({ grid }) => !grid);
  const long = rows.filter(({ tiles }) => tiles.length > 1);
  const broken = long.map((row) => bands.flatMap((band) => (band === row ? halves(band) : [band])));
  const followed = rows.filter((row) => rows.includes(bands[bands.indexOf(row) + 1]));
  const [best] = [...broken, ...followed.map((row) => withNext(bands, bands.indexOf(row)))].sort((a, b) => shown(b) - shown(a));
  return best && shown(best) > LARGER * shown(bands) ? spreadBands(best, width, height, chrome) : bands;
}

/** A row as two; of three pictures, the middle one comes above its neighbours. @param {Band} band */
function halves({ tiles }) {
  const upper = tiles.length === 3 ? [tiles[1]] : tiles.slice(0, Math.ceil(tiles.length / 2));
  return [upper, tiles.filter((tile) => !upper.includes(tile))].map(bandOf);
}

/** The bands with a row and its next one as one row. @param {Band[]} bands  @param {number} at */
function withNext(bands, at) {
  const tiles = [bands[at], bands[at + 1]].flatMap((band) => band.tiles);
  const row = bandOf(tiles.map((tile, column) => ({ ...tile, row: 0, column })));
  return [...bands.slice(0, at), row, ...bands.slice(at + 2)];
}

/** What the pictures of bands cover, px². */
function shownArea(bands, width, height, chrome) {
  const heights = heightsOf(bands, width, height, chrome);
  const boxes = bands.flatMap((band, i) => boxesOf(band, heights[i], width, chrome).boxes);
  return boxes.reduce((sum, box) => sum + box.width * box.height, 0);
}

/** Tiles by band, from the top: those in the same row, or in rows that a tile joins. */
function joined(tiles) {
  /** @type {Tile[][]} */
  const bands = [];
  let end = 0; // first row below the band
  for (const tile of [...tiles].sort((a, b) => a.row - b.row || a.column - b.column)) {
    if (!bands.length || tile.row >= end) bands.push([]);
    bands[bands.length - 1].push(tile);
    end = Math.max(end, tile.row + tile.row_span);
  }
  return bands;
}

/** @param {Tile[]} tiles  @returns {Band} */
function bandOf(tiles) {
  const grid = tiles.some(({ row_span, column_span }) => row_span > 1 || column_span > 1);
  const rows = covered(tiles, "row");
  const columns = covered(tiles, "column");
  const own = tiles.map((tile) => ({ ...tile, row: rows.indexOf(tile.row), column: columns.indexOf(tile.column) }));
  return { rows: rows.length, columns: columns.length, grid, tiles: own.sort((a, b) => a.row - b.row || a.column - b.column) };
}

/**
 * One grid with all tiles as they are placed, and a free row and column.
 * @param {Camera[]} cameras  @param {Record<string, Place>} places
 * @returns {Band}
 */
export function gridOf(cameras, places) {
  const tiles = cameras.map((camera) => ({ camera, ...places[camera.name] }));
  const free = (side) => 1 + Math.max(0, ...tiles.map((tile) => tile[side] + tile[`${side}_span`]));
  return { rows: free("row"), columns: free("column"), grid: true, tiles };
}

/** The rows or columns that any tile covers, in ascending order. */
export function covered(tiles, side) {
  const numbers = tiles.flatMap((tile) => Array.from({ length: tile[`${side}_span`] }, (_, i) => tile[side] + i));
  return [...new Set(numbers)].sort((a, b) => a - b);
}

/**
 * Height of the pictures in one row of each band: rows share the height, no band is wider than the area.
 * @param {Band[]} bands  @param {number} width  @param {number} height of the area
 * @param {number} chrome height of a tile without its picture
 * @returns {number[]}
 */
export function heightsOf(bands, width, height, chrome) {
  const count = bands.reduce((sum, { rows }) => sum + rows, 0);
  const available = height - count * chrome - (count - 1) * GAP;
  const highest = bands.map((band) => highestOf(band, width, chrome));
  const level = waterLevel(bands.flatMap(({ rows }, i) => Array(rows).fill(highest[i])), available);
  const limited = highest.filter((each) => each <= level);
  const cap = limited.length ? Math.max(...limited) * EVEN : Infinity;
  return highest.map((each) => Math.max(MIN_HEIGHT, Math.floor(Math.min(each, level, cap))));
}

/** Height of the pictures in a row at which a band is as wide as the area. */
function highestOf(band, width, chrome) {
  if (!band.grid) return (width - (band.tiles.length - 1) * GAP) / band.tiles.reduce((sum, { camera }) => sum + boxAspect(camera), 0);
  const column = (width - (band.columns - 1) * GAP) / band.columns;
  return Math.max(...band.tiles.map((tile) => rowFor(tile, column, chrome)));
}

/** Height of the pictures in a row at which a tile's picture fills its columns. */
const rowFor = ({ camera, row_span, column_span }, column, chrome) =>
  ((column * column_span + GAP * (column_span - 1)) / boxAspect(camera) - (row_span - 1) * (chrome + GAP)) / row_span;

/**
 * The boxes of a band's pictures, in the order of its tiles, and the width of a grid's columns (0: no grid). In
 * a grid, a box may have a different shape from its picture, which is then shown whole.
 * @param {Band} band  @param {number} height of the pictures in one of its rows  @param {number} width of the area  @param {number} chrome
 * @returns {{column: number, boxes: {width: number, height: number}[]}}
 */
export function boxesOf(band, height, width, chrome) {
  if (!band.grid) return { column: 0, boxes: band.tiles.map(({ camera }) => ({ width: Math.floor(height * boxAspect(camera)), height })) };
  const widest = (width - (band.columns - 1) * GAP) / band.columns;
  const wished = Math.max(...band.tiles.map((tile) => columnFor(tile, height, chrome)));
  const column = Math.floor(Math.min(widest, wished));
  const boxes = band.tiles.map((tile) =>
    ({ width: column * tile.column_span + GAP * (tile.column_span - 1), height: heightOf(tile, height, chrome) }));
  return { column, boxes };
}

/** Width of the columns at which a tile's picture fills its height. */
const columnFor = (tile, height, chrome) =>
  (heightOf(tile, height, chrome) * boxAspect(tile.camera) - GAP * (tile.column_span - 1)) / tile.column_span;

/** Height of a tile's picture, with the gaps and the chrome of the tiles that it spans. */
const heightOf = ({ row_span }, height, chrome) => height * row_span + (chrome + GAP) * (row_span - 1);

const boxAspect = ({ width, height }) => Math.max(1, width / height);

/** The level L with sum(min(limit, L)) = total. */
function waterLevel(limits, total) {
  const sorted = [...limits].sort((a, b) => a - b);
  let left = total;
  for (const [i, limit] of sorted.entries()) {
    const share = left / (sorted.length - i);
    if (limit >= share) return share;
    left -= limit;
  }
  return sorted.at(-1) ?? 0;
}
