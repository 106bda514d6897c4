/** What a window shows of each camera: in tiles, straightened, from above, in both; and how often it states that. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { latticeOf, groundOf, sightOf } from "../../runner/page/static/ground.js";
import { NOWHERE, seenFromAbove, seenInBox, seenStraight, Stating, united } from "../../runner/page/static/seen.js";
import { straightMesh } from "../../runner/page/static/straight.js";

const FULL = { x: 0, y: 0, width: 1920, height: 1080 };
const whole = (mirrored = false) => ({ fit: /** @type {const} */ ("contain"), mirrored });
const cover = (mirrored = false) => ({ fit: /** @type {const} */ ("cover"), mirrored });
const box = (width, height, view = whole(), ratio = 1) => ({ width, height, ratio, view });
const seen = (x, y, width, height, screen_width, screen_height) => ({ x, y, width, height, screen_width, screen_height });

const BOXES = [
  ["a whole picture", FULL, box(960, 540), seen(0, 0, 1920, 1080, 960, 540)],
  ["with bars beside it", FULL, box(1200, 540), seen(0, 0, 1920, 1080, 960, 540)],
  ["on a screen with two px in each CSS px", FULL, box(960, 540, whole(), 2), seen(0, 0, 1920, 1080, 1920, 1080)],
  ["larger than the image", FULL, box(3840, 2160), seen(0, 0, 1920, 1080, 3840, 2160)],
  ["cropped at its sides", FULL, box(270, 540, cover()), seen(690, 0, 540, 1080, 270, 540)],
  ["cropped and mirrored: the middle stays", FULL, box(270, 540, cover(true)), seen(690, 0, 540, 1080, 270, 540)],
  ["cropped above and below", FULL, box(960, 270, cover()), seen(0, 270, 1920, 540, 960, 270)],
  ["a part of the image that was chosen", { x: 100, y: 50, width: 640, height: 360 }, box(320, 360, cover()), seen(260, 50, 320, 360, 320, 360)],
  ["not in whole px: all that is touched", { ...FULL, width: 1921 }, box(100, 1080, cover()), seen(910, 0, 101, 1080, 101, 1080)],
  ["a box that is hidden", FULL, box(0, 0), NOWHERE],
  ["a box of NaN", FULL, box(NaN, 540), NOWHERE],
];

for (const [name, frame, display, expected] of /** @type {any[]} */ (BOXES))
  test(`in a tile: ${name}`, () => assert.deepEqual(seenInBox(frame, display), expected));

// --- straightened -----------------------------------------------------------------------------------------------------

const NATIVE = { width: 1280, height: 800, left: 0, top: 0 };
const POSE = { x_m: 2, y_m: 0, z_m: 1, yaw_deg: 0, pitch_deg: 0, roll_deg: 0 };
const FISHEYE = { pose: POSE, fov_deg: 180, lens: /** @type {const} */ ("fisheye"), native: NATIVE, width: 1280, height: 800 };
const IMAGE = { x: 0, y: 0, width: 1280, height: 800 };
const mesh = straightMesh(FISHEYE);

test("straightened, the middle 100 degrees of a fisheye are seen, magnified most where its px are wide apart", () => {
  const found = seenStraight(IMAGE, box(1280, 800), mesh, FISHEYE);
  // 100 of 180 degrees across: 711 px of 1280, as many on both sides of the middle.
  assert.ok(Math.abs(found.width - 712) <= 2 && Math.abs(found.x - 284) <= 1, JSON.stringify(found));
  assert.equal(found.x + found.width / 2, 640);
  // Per radian the rectilinear image has 640 / tan(50 degrees) px in the middle, 1.3 times those of the fisheye; more at its sides.
  const middle = 640 / Math.tan((50 * Math.PI) / 180) / (640 / (Math.PI / 2));
  const scale = found.screen_width / found.width;
  assert.ok(scale > middle && scale < middle / Math.cos((50 * Math.PI) / 180) ** 2 + 0.1, `${scale}, in the middle ${middle}`);
});

test("straightened and cropped, less of it is seen", () => {
  const [all, part] = [box(1280, 800), box(320, 800, cover())].map((display) => seenStraight(IMAGE, display, mesh, FISHEYE));
  assert.ok(part.width < 0.4 * all.width && part.height <= all.height, JSON.stringify(part));
  assert.equal(part.x + part.width / 2, 640);
});

test("straightened, nothing is seen beyond the part of the image that was chosen", () => {
  const found = seenStraight({ x: 640, y: 400, width: 320, height: 200 }, box(640, 400), mesh, FISHEYE);
  assert.deepEqual([found.x, found.y, found.width, found.height], [640, 400, 320, 200]);
  assert.equal(seenStraight(IMAGE, box(0, 400), mesh, FISHEYE), NOWHERE);
});

// --- from above -------------------------------------------------------------------------------------------------------

const CAR = { wheelbase_m: 2.9, track_m: 1.6, width_m: 2, front_m: 4, rear_m: 1 };
const down = (x_m, y_m, yaw_deg) => ({ ...FISHEYE, pose: { x_m, y_m, z_m: 1, yaw_deg, pitch_deg: 35, roll_deg: 0 } });
const AROUND = [down(4.1, 0, 0), down(2, 1.1, 90), down(2, -1.1, -90), down(-1.1, 0, 180)];
const lattice = latticeOf(groundOf(CAR).extent);
const sights = AROUND.map((camera) => sightOf(camera, CAR, lattice.places));
const above = (display, frames = AROUND.map(() => IMAGE)) => seenFromAbove(sights, lattice, frames, display, CAR);

test("from above, each camera shows the ground that it has a share of, and the image above the horizon is not seen", () => {
  for (const found of above(box(400, 460))) {
    const horizon = 400 - (640 / (Math.PI / 2)) * ((35 * Math.PI) / 180); // of an equidistant fisheye tipped down by 35 degrees
    assert.ok(found.width > 640 && found.height > 300, JSON.stringify(found));
    assert.ok(found.y > horizon && found.y + found.height <= 800, JSON.stringify([found, horizon]));
  }
});

test("from above, a view of twice the size has twice the px", () => {
  const [small, large] = [above(box(200, 230)), above(box(200, 230, whole(), 2))];
  for (const [i, { screen_width, ...part }] of small.entries()) {
    const { screen_width: twice, ...same } = large[i];
    assert.deepEqual([part.x, part.y, part.width, part.height], [same.x, same.y, same.width, same.height]);
    assert.ok(Math.abs(twice - 2 * screen_width) <= 2, `${twice}, not twice ${screen_width}`);
  }
});

test("from above, a part of an image that was chosen shows no more than that", () => {
  const frame = { x: 400, y: 400, width: 480, height: 300 };
  const [found] = above(box(400, 460), [frame, IMAGE, IMAGE, IMAGE]);
  assert.ok(found.x >= 400 && found.y >= 400 && found.x + found.width <= 880 && found.y + found.height <= 700, JSON.stringify(found));
});

// --- both, and when ---------------------------------------------------------------------------------------------------

test("a camera that is shown twice is seen in both, as large as the larger one", () => {
  const [one, other] = [seen(0, 0, 100, 100, 50, 50), seen(300, 200, 100, 100, 200, 200)];
  assert.deepEqual(united(one, other), seen(0, 0, 400, 300, 800, 600));
  assert.deepEqual([united(one, NOWHERE), united(NOWHERE, one), united(NOWHERE, NOWHERE)], [one, one, NOWHERE]);
});

test("what is shown is stated on change, at most ten times a second, and again every 0.5 s", () => {
  const stating = new Stating();
  const stated = [];
  for (let now = 0; now < 2000; now += 10) if (stating.states(now < 1000 ? "same" : `${now}`, now)) stated.push(now);
  assert.deepEqual(stated, [0, 500, 1000, 1100, 1200, 1300, 1400, 1500, 1600, 1700, 1800, 1900]);
});
