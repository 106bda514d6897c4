/** A fisheye's image as a rectilinear lens in the same place would show it: straight lines stay straight. Pure; px. */

import { projection, sightline } from "./projection.js";
import { trianglesOf } from "./ground.js";

const MAX_FOV_DEG = 100; // a wider image is stretched too much towards the sides
const COLUMNS = 64; // of cells; interpolation between their vertices has an error of 0.1 px of 1280

/** @typedef {import("./projection.js").Optics} Optics */

/** @param {{lens: string}} camera */
export const canStraighten = ({ lens }) => lens === "fisheye";

/**
 * The rectilinear lens. Its image has the camera's size, and magnifies the middle.
 * @template {{pose: Optics["pose"]|null, fov_deg: number, native: Optics["native"]}} C
 * @param {C} camera
 */
export const straightOptics = (camera) => ({
  ...camera,
  pose: camera.pose ?? { x_m: 0, y_m: 0, z_m: 0, yaw_deg: 0, pitch_deg: 0, roll_deg: 0 }, // any pose will do: it cancels out
  fov_deg: Math.min(MAX_FOV_DEG, camera.fov_deg),
  lens: /** @type {const} */ ("pinhole"),
});

/**
 * Points of the straightened image, and the points of the camera's image shown there.
 * @param {{pose: Optics["pose"]|null, fov_deg: number, lens: Optics["lens"], native: Optics["native"],
 *   width: number, height: number}} camera
 */
export function straightMesh(camera) {
  const optics = straightOptics(camera);
  const rows = Math.ceil((COLUMNS * camera.height) / camera.width);
  const lattice = Array.from({ length: (rows + 1) * (COLUMNS + 1) }, (_, i) => ({
    x: (camera.width * (i % (COLUMNS + 1))) / COLUMNS,
    y: (camera.height * Math.floor(i / (COLUMNS + 1))) / rows,
  }));
  const points = lattice.map(sightline(optics)).map(projection({ ...camera, pose: optics.pose }));
  const shares = new Float32Array(points.length).fill(1);
  return { columns: COLUMNS + 1, places: lattice, points, shares, triangles: trianglesOf(COLUMNS + 1, rows + 1, points, shares) };
}
