/** Layout of the tiles: rows as placed in the vehicle file, pictures in the aspect ratio of the full image. */

const GAP = 8;
const EVEN = 1.25; // a row is at most this much higher than the highest row limited by the width

/**
 * Rows of tiles. Cameras without a place follow in separate rows, as long as the longest row with places.
 * @returns {{camera: object, column: number}[][]}
 */
export function rowsOf(cameras) {
  const placed = new Map();
  for (const camera of cameras.filter(({ place }) => place)) {
    const { row, column } = camera.place;
    placed.set(row, [...(placed.get(row) ?? []), { camera, column }]);
  }
  const rows = [...placed.entries()].sort(([a], [b]) => a - b).map(([, row]) => row.sort((a, b) => a.column - b.column));
  const others = cameras.filter(({ place }) => !place);
  const longest = Math.max(...rows.map((row) => row.length), others.length ? Math.ceil(Math.sqrt(others.length)) : 1);
  for (let i = 0; i < others.length; i += longest)
    rows.push(others.slice(i, i + longest).map((camera, column) => ({ camera, column })));
  return rows;
}

/**
 * Height of the pictures in each row: rows share the height, none is wider than the area.
 * @param {{camera: {width, height}}[][]} rows  @param {number} width  @param {number} height of the area
 * @param {number} chrome height of a tile without its picture
 */
export function heightsOf(rows, width, height, chrome) {
  const available = height - rows.length * chrome - (rows.length - 1) * GAP;
  const highest = rows.map((row) => {
    const aspects = row.reduce((sum, { camera }) => sum + camera.width / camera.height, 0);
    return (width - (row.length - 1) * GAP) / aspects;
  });
  const level = waterLevel(highest, available);
  const limited = highest.filter((each) => each <= level);
  const cap = limited.length ? Math.max(...limited) * EVEN : Infinity;
  return highest.map((each) => Math.max(24, Math.floor(Math.min(each, level, cap))));
}

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
