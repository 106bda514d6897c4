/** The Drive view: which camera looks where, and the boxes of the pictures. Pure; lengths in px. */

const AHEAD_DEG = 30; // a camera within this of straight ahead is the front camera
const BEHIND_DEG = 135; // a camera turned further than this looks backwards
const DOWN_DEG = 25; // a camera tipped down by this much is a top view
const GAP = 4;
// Shares of the area: the front camera's minimum, and of its height or width for the others.
const FRONT = 0.42;
const BAND = { min: 0.1, usual: 0.14, max: 0.22 }; // above the pictures: the mirror and the figures
const BAND_WITHOUT_MIRROR = { min: 0.1, usual: 0.1, max: 0.12 };
const STRIP = { min: 0.1, usual: 0.17 };
const SIDE = { min: 0.07, usual: 0.12, max: 0.16 };
const COLUMN = 0.14;
const NARROW = 1.3; // width / height below which an area is narrow
const MIRROR = 0.3; // maximum share of the width

/** @typedef {import("./framing.js").View} View */
/** @typedef {{x: number, y: number, width: number, height: number}} Box */
/** @typedef {Box & {view: View}} Framed a picture's box and how the picture is placed in it */
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
 * The box of each picture, of the band above them, and of the mirror in its middle (of no width without one). No two boxes
 * of pictures overlap. A bird's-eye view replaces the top views in the row, except the main one.
 * @param {Camera[]} cameras  @param {number} width  @param {number} height of the area
 * @param {string|null} main camera that is swapped with the front camera
 * @param {{width: number, height: number}|null} birdseye its size, in any unit; null: none
 * @param {import("./placing.js").Places|null} places that an operator has saved
 * @returns {{band: Box, mirror: Box, pictures: Map<string, Framed>}} pictures of cameras, and BIRDSEYE
 */
export function arrange(cameras, width, height, main = null, birdseye = null, places = null) {
  const large = [main, places?.front, places?.left, places?.right, places?.rear];
  const kept = cameras.filter((each) => !birdseye || !isTopView(each) || large.includes(each.name));
  const roles = rolesOf(birdseye ? [...kept, asCamera(birdseye)] : kept, places);
  const area = (found) => (roles.front ? found.pictures.get(roles.front.name).width : 0);
  const hasSides = roles.left || roles.right || !roles.others.length;
  const found = [withStrip(roles, width, height), ...(hasSides ? [] : [withColumn(roles, width, height)])];
  const best = found.sort((a, b) => area(b) - area(a))[0];
  swap(best.pictures, roles.front?.name, main);
  return best;
}

/** @returns {Camera} */
const asCamera = (birdseye) => ({ ...birdseye, name: BIRDSEYE, pose: null, framing: null });

/** Swap two cameras; both are shown whole. */
function swap(pictures, front, main) {
  const [a, b] = [pictures.get(front), pictures.get(main)];
  if (!a || !b || a === b) return;
  const whole = (box, { mirrored }) => ({ ...box, view: { fit: "contain", align: 0.5, mirrored } });
  pictures.set(main, whole(a, b.view)).set(front, whole(b, a.view));
}

/** Neighbours at both sides of the front camera, the others in a row below. */
function withStrip(roles, width, height) {
  const { front, left, right, others } = roles;
  const sides = [left, right].filter((side) => side !== null).length;
  const room = roomAbove(roles);
  const strip = others.length ? STRIP : { min: 0, usual: 0 };
  const gaps = GAP * (others.length ? 2 : 1);
  const wide = front ? frontWidth(aspectOf(front), width, height, sides, room.min + strip.min, room.usual + strip.usual, gaps) : 0;
  const high = front ? Math.floor(wide / aspectOf(front)) : 0;
  const rest = height - high - gaps;
  const row = others.length ? rowHeight(others, width, height, rest, room) : 0;
  const band = bandOf(roles, width, Math.floor(Math.min(rest - row, room.max * height)));
  const middle = { y: band.band.height + GAP, height: height - band.band.height - row - gaps };
  const side = sides ? Math.floor((width - wide) / sides) - GAP : 0;
  const at = left ? side + GAP : sides ? 0 : Math.floor((width - wide) / 2);
  const pictures = band.pictures;
  if (left) pictures.set(left.name, { x: 0, ...middle, width: side, view: viewOf(left, "fill", 1) });
  const y = middle.y + Math.floor((middle.height - high) / 2);
  if (front) pictures.set(front.name, { x: at, y, width: wide, height: high, view: viewOf(front) });
  if (right) pictures.set(right.name, { x: at + wide + GAP, ...middle, width: side, view: viewOf(right, "fill", 0) });
  const total = Math.ceil(sum(others.map((camera) => row * aspectOf(camera) + GAP)) - GAP);
  let x = Math.max(0, Math.floor((width - total) / 2));
  for (const camera of others) {
    const own = Math.floor(row * aspectOf(camera));
    pictures.set(camera.name, { x, y: height - row, width: own, height: row, view: viewOf(camera) });
    x += own + GAP;
  }
  return { ...band, pictures };
}

/**
 * The front camera's width: at least its share of the area, beyond that what the height allows and the sides leave. In a
 * narrow area, next to the open drawer, the sides have priority.
 */
function frontWidth(aspect, width, height, sides, min, usual, gaps) {
  const share = Math.sqrt(FRONT * width * height * aspect);
  const roomy = (height * (1 - usual) - gaps) * aspect;
  const low = sides ? width * (1 - sides * SIDE.max) : 0;
  const high = width * (1 - sides * SIDE.usual);
  const wanted = width < NARROW * height ? low || roomy : Math.max(share, Math.min(Math.max(roomy, low), high));
  return Math.floor(Math.min(wanted, (height * (1 - min) - gaps) * aspect, width * (1 - sides * SIDE.min)));
}

/** Height of the row below: limited by the width, and about half of the rest, which it shares with the band. */
function rowHeight(others, width, height, rest, room) {
  const widest = (width - GAP * (others.length - 1)) / sum(others.map(aspectOf));
  const wanted = Math.max(rest * 0.55, rest - room.max * height);
  return Math.floor(Math.min(widest, wanted, rest - room.min * height));
}

/** Without neighbours: the others in a column at the right, which leaves a wide screen's height to the front camera. */
function withColumn(roles, width, height) {
  const { front, others } = roles;
  const room = roomAbove(roles);
  const wide = Math.floor(Math.min(width * (1 - COLUMN) - GAP, (height * (1 - room.usual) - GAP) * aspectOf(front)));
  const high = Math.floor(wide / aspectOf(front));
  const band = bandOf(roles, width, Math.floor(Math.min(height - high - GAP, room.max * height)));
  const y = band.band.height + GAP;
  const available = height - y - GAP * (others.length - 1);
  const column = Math.min(width - wide - GAP, available / sum(others.map((camera) => 1 / aspectOf(camera))));
  band.pictures.set(front.name, { x: 0, y, width: wide, height: high, view: viewOf(front) });
  let down = y;
  for (const camera of others) {
    const own = Math.floor(column / aspectOf(camera));
    band.pictures.set(camera.name, { x: wide + GAP, y: down, width: Math.floor(column), height: own, view: viewOf(camera) });
    down += own + GAP;
  }
  return band;
}

const roomAbove = ({ rear }) => (rear ? BAND : BAND_WITHOUT_MIRROR);

/** The band, with the rear view in its middle. */
function bandOf({ rear }, width, height) {
  const wide = rear ? Math.floor(Math.min(height * aspectOf(rear), width * MIRROR)) : 0;
  const mirror = { x: Math.floor((width - wide) / 2), y: 0, width: wide, height };
  /** @type {Map<string, Framed>} */
  const pictures = new Map(rear ? [[rear.name, { ...mirror, view: viewOf(rear) }]] : []);
  return { band: { x: 0, y: 0, width, height }, mirror, pictures };
}

const aspectOf = ({ width, height }) => width / height;
const sum = (values) => values.reduce((a, b) => a + b, 0);

/**
 * @param {Camera} camera  @param {"fit"|"fill"} usual unless the camera states it  @param {number} align where it is cropped
 * @returns {View}
 */
export function viewOf(camera, usual = "fit", align = 0.5) {
  const fills = (camera.framing ?? usual) === "fill";
  return { fit: fills ? "cover" : "contain", align: fills ? align : 0.5, mirrored: looksBackwards(camera) };
}
