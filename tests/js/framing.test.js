/** Points on the screen and in the picture: whole, cropped and mirrored. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { framingText, imageToBox, placement, toBox, toPicture, visible, WHOLE } from "../../runner/page/static/framing.js";

const PICTURE = { width: 1920, height: 1080 };
const NARROW = { width: 270, height: 1080 };
const cover = (mirrored = false) => ({ fit: "cover", mirrored });
const near = (found, expected) => {
  for (const key of Object.keys(expected)) assert.ok(Math.abs(found[key] - expected[key]) < 1e-9, `${key}: ${found[key]}, not ${expected[key]}`);
};

test("a whole picture is centred in its box", () => {
  near(placement({ width: 960, height: 1000 }, PICTURE, WHOLE), { scale: 0.5, x: 0, y: 230, width: 960, height: 540 });
  near(toPicture({ x: 480, y: 500 }, { width: 960, height: 1000 }, PICTURE, WHOLE), { x: 960, y: 540 });
});

test("a cropped picture keeps its middle", () => {
  near(visible(NARROW, PICTURE, cover()), { x: 825, y: 0, width: 270, height: 1080 });
  near(toPicture({ x: 0, y: 0 }, NARROW, PICTURE, cover()), { x: 825, y: 0 });
  near(toPicture({ x: 270, y: 1080 }, NARROW, PICTURE, cover()), { x: 1095, y: 1080 });
});

test("a mirrored picture has its right side on the left", () => {
  const mirrored = { ...WHOLE, mirrored: true };
  near(toPicture({ x: 100, y: 20 }, { width: 960, height: 540 }, PICTURE, mirrored), { x: 1720, y: 40 });
  near(toBox({ x: 1720, y: 40, width: 200, height: 100 }, { width: 960, height: 540 }, PICTURE, mirrored), { x: 0, y: 20, width: 100, height: 50 });
});

test("a mirrored and cropped picture keeps its middle as well", () => {
  near(visible(NARROW, PICTURE, cover(true)), { x: 825, width: 270 });
  near(toPicture({ x: 0, y: 0 }, NARROW, PICTURE, cover(true)), { x: 1095, y: 0 });
  near(toPicture({ x: 270, y: 0 }, NARROW, PICTURE, cover(true)), { x: 825, y: 0 });
});

test("a rectangle survives the round trip from box to picture and back", () => {
  for (const mirrored of [false, true])
    for (const fit of ["contain", "cover"])
      for (const box of [NARROW, { width: 800, height: 300 }]) {
        const view = { fit, mirrored };
        const [a, b] = [{ x: 31, y: 47 }, { x: 203, y: 211 }].map((point) => toPicture(point, box, PICTURE, view));
        const part = { x: Math.min(a.x, b.x), y: Math.min(a.y, b.y), width: Math.abs(a.x - b.x), height: Math.abs(a.y - b.y) };
        near(toBox(part, box, PICTURE, view), { x: 31, y: 47, width: 172, height: 164 });
      }
});

test("a point of the full image maps to the box through region, scale, crop and mirror", () => {
  const region = { x: 480, y: 260, width: 960, height: 540 };
  const half = { width: 480, height: 270 }; // px of the received picture
  near(imageToBox({ width: 960, height: 600 }, half, WHOLE, region)({ x: 480 + 240, y: 260 + 54 }), { x: 240, y: 30 + 54 });
  near(imageToBox({ width: 960, height: 540 }, half, { ...WHOLE, mirrored: true }, region)({ x: 480 + 240, y: 260 }), { x: 720, y: 0 });
  near(imageToBox({ width: 270, height: 540 }, half, cover(), region)({ x: 480 + 480, y: 260 + 540 }), { x: 135, y: 540 });
  near(imageToBox({ width: 270, height: 540 }, half, cover(), region)({ x: 0, y: 0 }), { x: 135 - 480 - 480, y: -260 });
  for (const view of [WHOLE, cover(), cover(true)]) {
    const there = imageToBox({ width: 333, height: 222 }, half, view, region)({ x: 700, y: 500 });
    near(toPicture(there, { width: 333, height: 222 }, half, view), { x: 110, y: 120 });
  }
});

test("cropping and mirroring are stated, and nothing else", () => {
  assert.equal(framingText({ width: 960, height: 540 }, PICTURE, WHOLE), "");
  assert.equal(framingText({ width: 960, height: 900 }, PICTURE, WHOLE), "");
  assert.equal(framingText(NARROW, PICTURE, cover()), "middle 14 % shown");
  assert.equal(framingText({ width: 1920, height: 540 }, PICTURE, cover()), "middle 50 % of the height shown");
  assert.equal(framingText({ width: 960, height: 540 }, PICTURE, { ...WHOLE, mirrored: true }), "mirrored");
});
