/** The ground around the vehicle seen from above: what each camera sees of it, and which picture is used where. Pure; m and px. */

import { projection } from "./projection.js";

export const REACH_M = 9; // beyond the vehicle, on every side
const CELL_M = 0.3; // of the lattice; the image is interpolated between its vertices, with an error of 1 cm near a camera 1 m high
const FEATHER = 0.12; // of the shorter side of a region: width of the edge in which a picture fades out
const FALLOFF = 10; // power of the distance by which a camera's weight falls: a seam is about 1 m wide

/** @typedef {import("./projection.js").Place} Place */
/** @typedef {import("./projection.js").Point} Point */
/** @typedef {import("./projection.js").Optics} Optics */
/** @typedef {import("./guides.js").Dimensions} Dimensions */
/** @typedef {import("./framing.js").Rectangle} Rectangle */
/** @typedef {{rear: number, front: number, right: number, left: number}} Extent along x from rear to front, along y from right to left */
/** @typedef {{places: Place[], columns: number, rows: number}} Lattice rows from the rear to the front, each from right to left */
/**
 * @typedef {{points: (Point|null)[], near: number[]}} Sight of a camera, for each vertex: its point in the full image,
 * and its weight there
 */

/**
 * The vehicle's outline on the ground, with a margin.
 * @param {Dimensions} dimensions
 * @param {number} margin
 * @returns {Extent}
 */
export function outline({ width_m, front_m, rear_m }, margin = 0) {
  const half = width_m / 2 + margin;
  return { rear: -rear_m - margin, front: front_m + margin, right: -half, left: half };
}

/**
 * The ground that the bird's-eye view shows, and how large it is.
 * @param {Dimensions} dimensions
 */
export function groundOf(dimensions) {
  const extent = outline(dimensions, REACH_M);
  return { extent, width: extent.left - extent.right, height: extent.front - extent.rear };
}

/**
 * Places on the ground, in cells of equal size.
 * @param {Extent} extent
 * @returns {Lattice}
 */
export function latticeOf({ rear, front, right, left }) {
  const steps = (low, high) => {
    const count = Math.ceil((high - low) / CELL_M);
    return Array.from({ length: count + 1 }, (_, i) => low + ((high - low) * i) / count);
  };
  const [along, across] = [steps(rear, front), steps(right, left)];
  return { places: along.flatMap((x) => across.map((y) => ({ x, y, z: 0 }))), columns: across.length, rows: along.length };
}

/**
 * What a camera sees of the ground. The vehicle, assumed to be as high as the camera, hides what is behind it from a camera
 * on its outside; a camera above the vehicle sees everything.
 * @param {Optics} optics  @param {Dimensions} dimensions  @param {Place[]} places
 * @returns {Sight}
 */
export function sightOf(optics, dimensions, places) {
  const toImage = projection(optics);
  const { x_m, y_m, z_m } = optics.pose;
  const [body, eye] = [outline(dimensions), { x: x_m, y: y_m }];
  const outside = !crosses(eye, eye, body);
  const nearness = (place) => Math.hypot(place.x - x_m, place.y - y_m, z_m) ** -FALLOFF;
  const near = places.map((place) => (outside && crosses(eye, place, body) ? 0 : nearness(place)));
  return { points: places.map(toImage), near };
}

/** Whether a line from a to b passes through the inside of an extent. */
export function crosses(a, b, { rear, front, right, left }) {
  let [enter, leave] = [0, 1];
  for (const [from, to, low, high] of [[a.x, b.x, rear, front], [a.y, b.y, right, left]]) {
    if (from === to) {
      if (from <= low || from >= high) return false;
      continue;
    }
    const [first, second] = [(low - from) / (to - from), (high - from) / (to - from)];
    enter = Math.max(enter, Math.min(first, second));
    leave = Math.min(leave, Math.max(first, second));
  }
  return enter < leave;
}

/**
 * Each camera's share of the picture at each vertex. Shares add up to 1 where any camera sees the ground, and fade out
 * towards the edges of a picture.
 * @param {Sight[]} sights
 * @param {Rectangle[]} regions of the full images that the pictures show
 * @returns {Float32Array[]}
 */
export function sharesOf(sights, regions) {
  const weights = sights.map(({ points, near }, i) => {
    const fade = fading(regions[i]);
    return Float64Array.from(points, (point, vertex) => (point ? near[vertex] * fade(point) : 0));
  });
  const shares = weights.map(({ length }) => new Float32Array(length));
  for (let vertex = 0; vertex < (weights[0]?.length ?? 0); vertex++) {
    const total = weights.reduce((sum, each) => sum + each[vertex], 0);
    if (total > 0) for (const [i, each] of weights.entries()) shares[i][vertex] = each[vertex] / total;
  }
  return shares;
}

/** 1 inside a rectangle, 0 outside, with a ramp inside its edges. */
function fading({ x, y, width, height }) {
  const wide = FEATHER * Math.min(width, height);
  return (point) => {
    const inside = Math.min(point.x - x, x + width - point.x, point.y - y, y + height - point.y);
    return Math.min(1, Math.max(0, inside / wide));
  };
}

/**
 * Two triangles for each cell of a lattice, as indices of vertices; none with a vertex without an image, or without any share.
 * @param {number} columns  @param {number} rows of vertices
 * @param {(Point|null)[]} points  @param {Float32Array} shares
 */
export function trianglesOf(columns, rows, points, shares) {
  /** @type {number[]} */
  const found = [];
  const isDrawn = (corners) => corners.every((corner) => points[corner]) && corners.some((corner) => shares[corner] > 0);
  const add = (...corners) => isDrawn(corners) && found.push(...corners);
  for (let row = 0; row + 1 < rows; row++)
    for (let column = 0; column + 1 < columns; column++) {
      const at = row * columns + column;
      add(at, at + 1, at + columns);
      add(at + 1, at + columns + 1, at + columns);
    }
  return Uint32Array.from(found);
}

/**
 * Placement of the ground in a box on the screen, front up: px per metre, and the point of the ground below the rear axle.
 * @param {{width: number, height: number}} box  @param {Dimensions} dimensions
 */
export function groundPlacement(box, dimensions) {
  const { extent, width, height } = groundOf(dimensions);
  const px_per_m = Math.min(box.width / width, box.height / height);
  const [across, along] = [(extent.left + extent.right) / 2, (extent.front + extent.rear) / 2];
  return { px_per_m, x: box.width / 2 + across * px_per_m, y: box.height / 2 + along * px_per_m };
}

/**
 * Boxes moved so that none covers another: from the top one on, each goes below those that it would cover, and then up
 * again as far as the height needs it.
 * @template {{x: number, y: number, width: number, height: number}} B
 * @param {B[]} boxes  @param {number} height
 * @returns {B[]} from the top
 */
export function apart(boxes, height) {
  const isBeside = (a, b) => a.x < b.x + b.width && b.x < a.x + a.width;
  /** @type {B[]} */
  const down = [];
  for (const box of [...boxes].sort((a, b) => a.y - b.y)) {
    const y = Math.max(box.y, ...down.filter((other) => isBeside(other, box)).map((other) => other.y + other.height + 1));
    down.push({ ...box, y });
  }
  /** @type {B[]} */
  const placed = [];
  for (const box of down.reverse()) {
    const lowest = Math.min(height, ...placed.filter((other) => isBeside(other, box)).map((other) => other.y - 1));
    placed.unshift({ ...box, y: Math.min(box.y, lowest - box.height) });
  }
  return placed;
}
