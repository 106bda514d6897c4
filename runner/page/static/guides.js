/** Guide lines on the ground: the vehicle's width, distances, and the paths of its wheels. Pure; m, rad. */

/** @typedef {import("./projection.js").Place} Place */
/** @typedef {import("./projection.js").Point} Point */
/**
 * @typedef {object} Dimensions of the vehicle
 * @property {number} wheelbase_m between the axles
 * @property {number} track_m between the wheels of an axle
 * @property {number} width_m at its widest
 * @property {number} front_m from the rear axle to the front end
 * @property {number} rear_m from the rear axle to the rear end
 */
/** @typedef {{kind: "width"|"distance"|"path", metres: number|null, places: Place[]}} Guide metres: of a distance */

const REACH_M = 15; // beyond both ends of the vehicle
const DISTANCES_M = [1, 2, 5, 10, 15];
const PIECES = 48; // of a line along the drive, shorter ones near the vehicle
const ACROSS = 12; // of a line across it
const QUARTER = Math.PI / 2; // a path ends after a quarter turn

const ground = (x, y) => ({ x, y, z: 0 });

/** From 0 to a length, denser near the start: close things are large in a picture. */
const along = (length) => Array.from({ length: PIECES + 1 }, (_, i) => length * (i / PIECES) ** 2);

/**
 * Straight on, ahead and behind: the sides of the vehicle extended, and lines across at distances from its ends.
 * @param {Dimensions} dimensions
 * @returns {Guide[]}
 */
export function straightGuides({ width_m, front_m, rear_m }) {
  const half = width_m / 2;
  return [[front_m, 1], [-rear_m, -1]].flatMap(([end, sign]) => [
    ...[half, -half].map((y) => guide("width", along(REACH_M).map((far) => ground(end + sign * far, y)))),
    ...DISTANCES_M.map((far) => guide("distance", across(end + sign * far, half), far)),
  ]);
}

const across = (x, half) => Array.from({ length: ACROSS + 1 }, (_, i) => ground(x, half - (2 * half * i) / ACROSS));

/**
 * @param {Guide["kind"]} kind  @param {Place[]} places  @param {number|null} metres
 * @returns {Guide}
 */
const guide = (kind, places, metres = null) => ({ kind, metres, places });

/**
 * The paths of the front wheels ahead, and of the rear wheels backwards, at constant steering: single-track (bicycle) model
 * without slip; all points turn about one centre on the line of the rear axle, at wheelbase / tan(angle).
 * @param {Dimensions} dimensions
 * @param {number} rad angle of the front wheels, to the left
 * @returns {Guide[]}
 */
export function pathGuides({ wheelbase_m, track_m, front_m, rear_m }, rad) {
  const curvature = Math.tan(rad) / wheelbase_m;
  const wheels = [track_m / 2, -track_m / 2];
  const line = (axle, begins, sign) => {
    const most = Math.max(0, Math.min(REACH_M, QUARTER / Math.abs(curvature) - begins)); // no limit straight on
    const driven = along(most).map((far) => sign * (begins + far));
    return wheels.map((y) => guide("path", driven.map((s) => moved(ground(axle, y), s, curvature))));
  };
  return [...line(wheelbase_m, front_m - wheelbase_m, 1), ...line(0, rear_m, -1)];
}

/** Where a point of the vehicle is once the centre of the rear axle has travelled a distance, negative backwards. */
function moved({ x, y }, distance, curvature) {
  const turn = curvature * distance;
  const [sin, cos] = [Math.sin(turn), Math.cos(turn)];
  const [ahead, aside] = curvature ? [sin / curvature, (1 - cos) / curvature] : [distance, 0];
  return ground(ahead + x * cos - y * sin, aside + x * sin + y * cos);
}

/**
 * The pieces of a line that have an image.
 * @param {Place[]} places
 * @param {(place: Place) => Point|null} toImage
 * @returns {Point[][]}
 */
export function imageOf(places, toImage) {
  /** @type {Point[][]} */
  const pieces = [[]];
  for (const place of places) {
    const point = toImage(place);
    if (point) pieces[pieces.length - 1].push(point);
    else if (pieces[pieces.length - 1].length) pieces.push([]);
  }
  return pieces.filter((piece) => piece.length > 1);
}

// --- whose guides are shown -------------------------------------------------------------------------------------------

/** @typedef {"calibrated"|"all"|"none"} Choice */
const CHOICES = /** @type {Choice[]} */ (["calibrated", "all", "none"]);

/**
 * Whether a camera's guides are shown; an uncalibrated camera's only on request.
 * @param {{pose: object|null, calibrated: boolean}} camera
 * @param {Choice} choice
 */
export const isGuided = ({ pose, calibrated }, choice) => pose !== null && (choice === "all" || (choice === "calibrated" && calibrated));

/**
 * The next choice that changes which cameras have guides.
 * @param {{pose: object|null, calibrated: boolean}[]} cameras
 * @param {Choice} choice
 * @returns {Choice}
 */
export function nextChoice(cameras, choice) {
  const shown = (each) => cameras.filter((camera) => isGuided(camera, each)).length;
  const at = CHOICES.indexOf(choice);
  const others = [1, 2].map((step) => CHOICES[(at + step) % CHOICES.length]);
  return others.find((each) => shown(each) !== shown(choice)) ?? choice;
}
