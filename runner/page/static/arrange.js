/** The Drive view: which camera looks where, and the boxes of pictures and panels. Pure; lengths in px. */

import { WHOLE } from "./framing.js";

const AHEAD_DEG = 30; // a camera within this of straight ahead is the front camera
const BEHIND_DEG = 135; // a camera turned further than this looks backwards
const DOWN_DEG = 25; // a camera tipped down by this much is a top view
const GAP = 4;
// Shares of the area's width or height.
const COLUMN = { usual: 0.17, birdseye: 0.25 }; // beside the front picture, at least; with a bird's-eye view where there is height
const STRIP = { mirror: 0.14, sides: 0.23, max: 0.3 }; // above it: at least, with a free place; at most
const SHARED = 0.38; // of the strip's width, for each picture in it next to free places
const SMALL = { usual: 0.45, birdseye: 0.6 }; // of the column: small pictures, at most
const FRONT = 0.5; // the front picture in a tall area, at most
const BELOW = 0.2; // what a tall area keeps for the panels
const TALL = 1.1; // width / height below which an area is tall
const ROW = 0.95; // of the front picture's width; a row below it may cost the rest
const LEAST_PX = 56; // a lower rest of the area stays empty
const COLUMN_PX = 165; // at least
/** Share of the height that panels have in common; and the height at most: a share of the width, and px. The map gets the rest. */
const PANELS = { figures: [26, 0.35, 60], messages: [20, 0.3, 60], words: [16, 0.25, 50], map: [18, 0, 0], buttons: [26, 0.3, 90] };
const LEAST_MAP_PX = 90;

/** @typedef {import("./framing.js").View} View */
/** @typedef {{x: number, y: number, width: number, height: number}} Box */
/** @typedef {Box & {view: View}} Framed a picture's box and how the picture is placed in it */
/** @typedef {"figures"|"messages"|"words"|"map"|"buttons"} Panel */
/** @typedef {Record<"front"|"left"|"rear"|"right"|"row", Box>} Slots */
/**
 * @typedef {object} Arrangement
 * @property {Map<string, Framed>} pictures of cameras, and BIRDSEYE
 * @property {Partial<Record<Panel, Box>>} panels all but the map, for which there may be no room
 * @property {Slots} slots where pictures are, or would be, by place
 */
/**
 * @typedef {object} Camera
 * @property {string} name
 * @property {number} width
 * @property {number} height
 * @property {{yaw_deg: number, pitch_deg: number}|null} pose
 * @property {"fit"|"fill"|null} framing
 */
/** @typedef {{front: Camera|null, left: Camera|null, right: Camera|null, rear: Camera|null, others: Camera[]}} Roles */

export const BIRDSEYE = "bird's eye"; // in place of a camera's name, which cannot contain a space

/** Yaw in degrees to the left, from -180 to 180. */
const yawOf = ({ pose }) => pose && 180 - (((180 - pose.yaw_deg) % 360) + 360) % 360;
export const isTopView = ({ pose }) => pose !== null && pose.pitch_deg >= DOWN_DEG;
const looksBackwards = (camera) => camera.pose !== null && !isTopView(camera) && Math.abs(yawOf(camera)) >= BEHIND_DEG;

/**
 * The cameras by their role for a driver.
 * @param {Camera[]} cameras
 * @param {import("./placing.js").Places|null} places that an operator has saved; none without a camera for the front
 * @returns {Roles}
 */
export function rolesOf(cameras, places = null) {
  const named = (name) => cameras.find((camera) => camera.name === name) ?? null;
  const front = places && named(places.front);
  if (!front) return rolesByPose(cameras);
  const [left, right, rear] = [places.left, places.right, places.rear].map(named);
  const row = (places.row ?? []).map(named).filter((camera) => camera !== null);
  const others = cameras.filter((camera) => ![front, left, right, rear, ...row].includes(camera));
  return { front, left, right, rear, others: [...row, ...others] };
}

/**
 * The front camera is the one nearest to straight ahead, otherwise the first that looks forward, otherwise the first. Top
 * views and cameras without a role are the others, in their order.
 * @param {Camera[]} cameras
 * @returns {Roles}
 */
function rolesByPose(cameras) {
  const level = cameras.filter((camera) => camera.pose && !isTopView(camera));
  const front = nearest(level, 0, AHEAD_DEG) ?? level.find((camera) => Math.abs(yawOf(camera)) < 90) ?? cameras[0] ?? null;
  const rear = nearest(level.filter((camera) => camera !== front && looksBackwards(camera)), 180, 180);
  const ahead = front?.pose ? yawOf(front) : 0;
  const neighbour = (sign) => {
    const turned = (camera) => sign * (yawOf(camera) - ahead);
    const found = level.filter((camera) => camera !== front && !looksBackwards(camera) && turned(camera) > 0);
    return front?.pose ? (found.sort((a, b) => turned(a) - turned(b))[0] ?? null) : null;
  };
  const [left, right] = [neighbour(1), neighbour(-1)];
  return { front, left, right, rear, others: cameras.filter((camera) => ![front, left, right, rear].includes(camera)) };
}

/** The camera whose yaw is nearest to an angle, and within so many degrees of it. */
function nearest(cameras, yaw, within) {
  const away = (camera) => Math.min(Math.abs(yawOf(camera) - yaw), 360 - Math.abs(yawOf(camera) - yaw));
  return cameras.filter((camera) => away(camera) <= within).sort((a, b) => away(a) - away(b))[0] ?? null;
}

/**
 * The box of each picture and of each panel. Side and rear pictures are a strip above the front picture, as mirrors are
 * above a windscreen; small pictures and panels are in a column beside it, or below it where the area is tall. No two boxes
 * overlap. A bird's-eye view replaces the top views, except the main one.
 * @param {Camera[]} cameras  @param {number} width  @param {number} height of the area
 * @param {string|null} main camera that is swapped with the front camera
 * @param {{width: number, height: number}|null} birdseye its size, in any unit; null: none
 * @param {import("./placing.js").Places|null} places that an operator has saved
 * @returns {Arrangement}
 */
export function arrange(cameras, width, height, main = null, birdseye = null, places = null) {
  const large = [main, places?.front, places?.left, places?.right, places?.rear];
  const kept = cameras.filter((each) => !birdseye || !isTopView(each) || large.includes(each.name));
  const roles = rolesOf(kept, places);
  if (birdseye) roles.others.unshift({ ...birdseye, name: BIRDSEYE, pose: null, framing: null });
  const found = width < TALL * height ? stacked(roles, width, height) : beside(roles, width, height);
  swap(found.pictures, roles.front?.name, main);
  return found;
}

/** Swap two cameras; both are shown whole. */
function swap(pictures, front, main) {
  const [a, b] = [pictures.get(front), pictures.get(main)];
  if (!a || !b || a === b) return;
  const whole = (box, { mirrored }) => ({ ...box, view: { ...WHOLE, mirrored } });
  pictures.set(main, whole(a, b.view)).set(front, whole(b, a.view));
}

/** With a column at the right: the front picture is as large as the strip above it, a row below it and the column allow. */
function beside(roles, width, height) {
  const { front, others } = roles;
  const isHigh = others[0]?.name === BIRDSEYE && width < 1.5 * height;
  const column = Math.max(COLUMN_PX, width * (isHigh ? COLUMN.birdseye : COLUMN.usual));
  const widest = Math.floor(width - column) - GAP;
  const [alone, withRow] = [[], others].map((row) => frontWidth(roles, row, widest, height));
  const row = others.length > 1 && withRow >= ROW * alone ? others : [];
  const wide = row.length ? withRow : alone;
  const [high, low] = [heightOf(front, wide), rowHeight(row, wide)];
  const strip = stripOf(roles, wide, height, height - high - GAP - below(low));
  const { pictures } = strip;
  const y = below(strip.height);
  if (front) pictures.set(front.name, { x: 0, y, width: wide, height: high, view: viewOf(front) });
  put(pictures, row, { x: 0, y: y + high + GAP, width: wide, height: low });
  const side = { x: wide + GAP, y: 0, width: width - wide - GAP, height };
  const share = others[0]?.name === BIRDSEYE ? SMALL.birdseye : SMALL.usual;
  const small = putRows(pictures, row.length ? [] : others, side, share * height);
  const end = y + high + below(low) + GAP;
  const rest = height - end < LEAST_PX ? [] : [{ x: 0, y: end, width: wide, height: height - end }];
  const panels = panelsIn([...strip.free, ...rest], { ...side, height: height - below(small) });
  const head = { width: wide, height: Math.max(strip.height, STRIP.mirror * height) };
  return { pictures, panels, slots: slotsOf(roles, pictures, head, side) };
}

/** The largest width of the front picture at which all is inside the area. */
function frontWidth(roles, row, widest, height) {
  const needed = (wide) => below(leastStrip(roles, wide, height)) + heightOf(roles.front, wide) + below(rowHeight(row, wide));
  let [low, high] = [0, widest];
  while (low < high) {
    const middle = Math.ceil((low + high) / 2);
    if (needed(middle) <= height) low = middle;
    else high = middle - 1;
  }
  return low;
}

/** The parts of a tall area below each other: strip, front picture, small pictures, panels. */
function stacked(roles, width, height) {
  const { front, left, rear, right, others } = roles;
  const sides = [left, rear, right].filter((camera) => camera !== null);
  const strip = sides.length > 1 ? sides : [];
  const stripHigh = Math.floor(Math.min(rowHeight(strip, width), STRIP.sides * height));
  /** @type {Map<string, Framed>} */
  const pictures = new Map();
  put(pictures, strip, { x: 0, y: 0, width, height: stripHigh });
  const wide = front ? Math.floor(Math.min(width, FRONT * height * aspectOf(front))) : 0;
  const [y, high] = [below(stripHigh), heightOf(front, wide)];
  if (front) pictures.set(front.name, { x: Math.floor((width - wide) / 2), y, width: wide, height: high, view: viewOf(front) });
  const small = [...(strip.length ? [] : sides), ...others];
  const from = y + high + GAP;
  const used = putRows(pictures, small, { x: 0, y: from, width, height: 0 }, height - from - GAP - BELOW * height);
  const rest = { x: 0, y: from + below(used), width, height: height - from - below(used) };
  const head = { width, height: Math.max(stripHigh, STRIP.mirror * height) };
  return { pictures, panels: panelsIn([], rest), slots: slotsOf(roles, pictures, head, rest) };
}

// --- pictures ---------------------------------------------------------------------------------------------------------

/** Height of the strip at which it is as wide as the front picture, or where places in it are free, at least. */
function leastStrip({ left, rear, right }, wide, height) {
  const taken = [left, rear, right].filter((camera) => camera !== null);
  if (taken.length < 3) return Math.floor(height * (left || right ? STRIP.sides : rear ? STRIP.mirror : 0));
  return Math.floor(Math.min(rowHeight(taken, wide), STRIP.max * height));
}

/** The strip of side and rear pictures, from the left; free places are for panels, and so are the ends of a strip too short. */
function stripOf(roles, wide, height, most) {
  const slots = [roles.left, roles.rear, roles.right];
  const taken = slots.filter((camera) => camera !== null);
  const shared = taken.length < 3 ? (SHARED * taken.length * wide) / sum(taken.map(aspectOf)) : leastStrip(roles, wide, height);
  const own = Math.floor(Math.min(most, STRIP.max * height, shared));
  const isLow = taken.length < 3 && (taken.length ? most - own <= LEAST_PX : most > LEAST_PX); // the rest is too low for a panel
  const high = isLow ? Math.floor(most) : taken.length ? own : 0;
  const widths = taken.map((camera) => Math.floor(own * aspectOf(camera)));
  const isShort = taken.length === 3 && wide - sum(widths) > 2 * LEAST_PX;
  const places = isShort ? [null, ...slots, null] : slots.filter((camera, i) => camera || i === 0 || slots[i - 1]);
  const gaps = GAP * (places.length - 1);
  const share = Math.floor((wide - sum(widths) - gaps) / Math.max(1, places.length - taken.length));
  /** @type {{height: number, free: Box[], pictures: Map<string, Framed>}} */
  const strip = { height: high, free: [], pictures: new Map() };
  let x = 0;
  for (const camera of high ? places : []) {
    const width = camera ? widths[taken.indexOf(camera)] : share;
    if (camera) strip.pictures.set(camera.name, { x, y: 0, width, height: own, view: viewOf(camera) });
    else strip.free.push({ x, y: 0, width, height: high });
    x += width + GAP;
  }
  return strip;
}

/** Place small pictures in as many rows as show them largest, at the lower end of a box or, of no height, below its edge. */
function putRows(pictures, cameras, box, most) {
  const isAbove = cameras[0]?.name === BIRDSEYE; // it has a row of its own
  const rows = isAbove ? [[cameras[0]], ...rowsOf(cameras.slice(1), box.width, most / 3)] : rowsOf(cameras, box.width, most);
  const limit = (row) => (isAbove && row[0] !== cameras[0] ? most / 3 : most);
  const heights = rows.map((row) => Math.floor(Math.min(rowHeight(row, box.width), limit(row))));
  const total = sum(heights) + GAP * Math.max(0, rows.length - 1);
  let y = box.height ? box.y + box.height - total : box.y;
  for (const [i, row] of rows.entries()) {
    put(pictures, row, { ...box, y, height: heights[i] });
    y += heights[i] + GAP;
  }
  return total;
}

/** Cameras in rows of equal length, not higher than allowed together. */
function rowsOf(cameras, width, most) {
  const split = (count) => {
    const length = Math.ceil(cameras.length / count);
    return Array.from({ length: Math.ceil(cameras.length / length) }, (_, i) => cameras.slice(i * length, (i + 1) * length));
  };
  const total = (rows) => sum(rows.map((row) => rowHeight(row, width) + GAP));
  const found = cameras.map((_, i) => split(i + 1));
  return found.findLast((rows) => total(rows) <= most) ?? found[0] ?? [];
}

/** Place pictures side by side in the middle of a box. */
function put(pictures, row, box) {
  const widths = row.map((camera) => Math.floor(Math.min(box.height * aspectOf(camera), box.width)));
  let x = box.x + Math.floor((box.width - sum(widths) - GAP * (row.length - 1)) / 2);
  for (const [i, camera] of row.entries()) {
    pictures.set(camera.name, { x, y: box.y, width: widths[i], height: box.height, view: viewOf(camera) });
    x += widths[i] + GAP;
  }
}

/** Height of pictures side by side that are as wide as this. */
const rowHeight = (row, wide) => (row.length ? Math.floor((wide - GAP * (row.length - 1)) / sum(row.map(aspectOf))) : 0);
const heightOf = (camera, wide) => (camera ? Math.floor(wide / aspectOf(camera)) : 0);
/** A height with the gap next to it; 0 without one. */
const below = (height) => (height ? height + GAP : 0);
const aspectOf = ({ width, height }) => width / height;
const sum = (values) => values.reduce((a, b) => a + b, 0);

/** @param {Camera} camera  @returns {View} */
export const viewOf = (camera) => ({ fit: camera.framing === "fill" ? "cover" : "contain", mirrored: looksBackwards(camera) });

/** @returns {Slots} */
function slotsOf(roles, pictures, strip, row) {
  const wide = strip.width / 3;
  const slot = (role, i) => pictures.get(roles[role]?.name) ?? { x: i * wide, y: 0, width: wide, height: strip.height };
  return { front: pictures.get(roles.front?.name) ?? row, left: slot("left", 0), rear: slot("rear", 1), right: slot("right", 2), row };
}

// --- panels -----------------------------------------------------------------------------------------------------------

const ALL = /** @type {Panel[]} */ (Object.keys(PANELS));

/** The panels: what a driver reads most often in free places next to the front picture, if there are any. */
function panelsIn(free, column) {
  if (!free.length) return column.width > 1.5 * column.height ? abreast(column) : piled(column, ALL);
  const half = Math.floor((free[0].width - GAP) / 2);
  const isWide = free.length === 1 && half > 1.2 * free[0].height;
  const boxes = isWide ? [0, 1].map((i) => ({ ...free[0], x: free[0].x + i * (half + GAP), width: half })) : free;
  const freed = ALL.slice(0, boxes.length);
  const others = ALL.filter((name) => !freed.includes(name));
  return { ...Object.fromEntries(freed.map((name, i) => [name, boxes[i]])), ...piled(column, others) };
}

/** Panels below each other. */
function piled(box, names) {
  const weights = sum(names.map((name) => PANELS[name][0]));
  const heights = names.map((name) => {
    const [weight, share, px] = PANELS[name];
    return Math.floor(Math.min((weight / weights) * (box.height - GAP * (names.length - 1)), share * box.width + px));
  });
  const rest = box.height - sum(heights) - GAP * (names.length - 1);
  const map = names.indexOf("map");
  if (map >= 0 && rest < LEAST_MAP_PX) return piled(box, names.filter((name) => name !== "map"));
  heights[map >= 0 ? map : names.length - 1] += rest;
  let { y } = box;
  /** @type {Partial<Record<Panel, Box>>} */
  const panels = {};
  for (const [i, name] of names.entries()) {
    panels[name] = { ...box, y, height: heights[i] };
    y += heights[i] + GAP;
  }
  return panels;
}

/** Panels of a wide box: two columns, and the map where it is high enough. */
function abreast(box) {
  const map = box.height >= LEAST_MAP_PX ? Math.floor(Math.min(box.height, 0.25 * box.width)) : 0;
  const half = Math.floor((box.width - below(map) - GAP) / 2);
  const left = piled({ ...box, width: half }, ["figures", "words"]);
  const right = piled({ ...box, x: box.x + half + GAP, width: half }, ["messages", "buttons"]);
  return { ...left, ...right, ...(map && { map: { ...box, x: box.x + box.width - map, width: map } }) };
}
