/** Where points around the vehicle appear in a camera's full image. Pure; m, degrees and px. */

/** @typedef {{x: number, y: number}} Point */
/** @typedef {{x: number, y: number, z: number}} Place axes of ROS REP 103: forward, left, up, from the ground below the rear axle */
/**
 * @typedef {{x_m: number, y_m: number, z_m: number, yaw_deg: number, pitch_deg: number, roll_deg: number}} Pose
 * yaw to the left, pitch down, roll clockwise
 */
/**
 * @typedef {object} Optics
 * @property {Pose} pose
 * @property {number} fov_deg horizontal, of the native image
 * @property {"pinhole"|"fisheye"} lens a fisheye is equidistant: equal angles take equal numbers of px
 * @property {{width: number, height: number, left: number, top: number}} native the source's image, and where the full image begins in it
 */

const MIN_DEPTH = 1e-6; // smallest ratio of depth to distance from the axis that a pinhole sees
const BEHIND = 0.9 * Math.PI; // rad from the axis: beyond it a line through the back of a fisheye would cross its image

/**
 * A function from a place to its point in the full image, or null if it has none: behind the camera. The point may
 * lie outside the image; the middle of the first pixel is at 0.5.
 * @param {Optics} optics
 * @returns {(place: Place) => Point|null}
 */
export function projection({ pose, fov_deg, lens, native }) {
  const { forward, right, down } = axesOf(pose);
  const half = radians(fov_deg / 2);
  const focal = native.width / 2 / (lens === "fisheye" ? half : Math.tan(half)); // px per radian, or per unit of tangent
  const middle = { x: native.width / 2 - native.left, y: native.height / 2 - native.top };
  return ({ x, y, z }) => {
    const ray = [x - pose.x_m, y - pose.y_m, z - pose.z_m];
    const [depth, across, below] = [dot(ray, forward), dot(ray, right), dot(ray, down)];
    const aside = Math.hypot(across, below);
    const angle = Math.atan2(aside, depth);
    if (lens === "fisheye" ? angle > BEHIND : depth <= MIN_DEPTH * aside) return null;
    if (aside === 0) return { ...middle };
    const radius = focal * (lens === "fisheye" ? angle : aside / depth);
    return { x: middle.x + (across / aside) * radius, y: middle.y + (below / aside) * radius };
  };
}

/**
 * The inverse for a pinhole: a function from a point of the full image to the place seen there at a depth of 1 m.
 * @param {Optics} optics
 * @returns {(point: Point) => Place}
 */
export function sightline({ pose, fov_deg, native }) {
  const { forward, right, down } = axesOf(pose);
  const focal = native.width / 2 / Math.tan(radians(fov_deg / 2));
  return ({ x, y }) => {
    const across = (x + native.left - native.width / 2) / focal;
    const below = (y + native.top - native.height / 2) / focal;
    const [ahead, left, up] = forward.map((each, i) => each + across * right[i] + below * down[i]);
    return { x: pose.x_m + ahead, y: pose.y_m + left, z: pose.z_m + up };
  };
}

/** Directions of the camera in the vehicle's axes: along its view, and to the right and down in its picture. */
function axesOf({ yaw_deg, pitch_deg, roll_deg }) {
  const [sy, sp, sr] = [yaw_deg, pitch_deg, roll_deg].map((angle) => Math.sin(radians(angle)));
  const [cy, cp, cr] = [yaw_deg, pitch_deg, roll_deg].map((angle) => Math.cos(radians(angle)));
  const right = [sy, -cy, 0];
  const down = [-sp * cy, -sp * sy, -cp];
  return {
    forward: [cp * cy, cp * sy, -sp],
    right: right.map((each, i) => cr * each + sr * down[i]),
    down: down.map((each, i) => cr * each - sr * right[i]),
  };
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const radians = (degrees) => (degrees * Math.PI) / 180;
