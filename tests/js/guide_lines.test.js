import assert from "node:assert/strict";
import { test } from "node:test";

import { COLOURS, GuideLines, STEERING_STEP_RAD, withoutStraight } from "../../runner/page/static/guide_lines.js";

test("a straight line keeps its ends", () => {
  const points = Array.from({ length: 60 }, (_, i) => ({ x: 3 * i, y: 7 - 2 * i }));
  assert.deepEqual(withoutStraight(points), [points[0], points[59]]);
});

test("a curve stays within a quarter of a pixel of its points", () => {
  const points = Array.from({ length: 90 }, (_, i) => ({ x: 500 * Math.cos(i / 60), y: 300 * Math.sin(i / 60) }));
  const kept = withoutStraight(points);
  assert.ok(kept.length > 5 && kept.length < 40, `${kept.length}`);
  for (const point of points) {
    const after = kept.findIndex(({ x }) => x <= point.x);
    const [a, b] = [kept[Math.max(0, after - 1)], kept[Math.max(1, after)]];
    const apart = Math.abs((point.x - a.x) * (b.y - a.y) - (point.y - a.y) * (b.x - a.x)) / Math.hypot(b.x - a.x, b.y - a.y);
    assert.ok(apart < 0.25, `${apart}`);
  }
});

test("a corner, points that coincide, and short lines are kept", () => {
  const corner = [{ x: 0, y: 0 }, { x: 5, y: 0 }, { x: 5, y: 5 }];
  assert.deepEqual(withoutStraight(corner), corner);
  assert.deepEqual(withoutStraight(corner.slice(0, 1)), corner.slice(0, 1));
  assert.deepEqual(withoutStraight([]), []);
  const closed = [{ x: 0, y: 0 }, { x: 9, y: 0 }, { x: 0, y: 0 }];
  assert.deepEqual(withoutStraight(closed), closed);
});

// --- placed in the canvas -----------------------------------------------------------------------------------------------

const NATIVE = { width: 640, height: 360, left: 0, top: 0 };
const CAMERA = { native: NATIVE, fov_deg: 90, lens: "pinhole", pose: { x_m: 2, y_m: 0, z_m: 1.5, yaw_deg: 0, pitch_deg: 0, roll_deg: 0 }, calibrated: true };
const DIMENSIONS = { wheelbase_m: 2.9, track_m: 1.65, width_m: 1.92, front_m: 3.65, rear_m: 0.95 };

/** Draws into a canvas that records how many paths were built, and returns the lines and what was stroked, in order. */
function drawing() {
  const paths = { built: 0 };
  globalThis.Path2D = class {
    points = [];
    constructor() { paths.built++; }
    moveTo(x, y) { this.points.push([x, y]); }
    lineTo(x, y) { this.points.push([x, y]); }
  };
  const nothing = Object.fromEntries(["save", "restore", "strokeText", "fillText", "transform", "translate"].map((name) => [name, () => {}]));
  const lines = new GuideLines(CAMERA, DIMENSIONS);
  lines.shown = true;
  const draw = ({ region = { x: 0, y: 0, width: 640, height: 360 }, canvas = { width: 640, height: 360 }, rad = 0.1 } = {}) => {
    const area = { x: 0, y: 0, ...canvas };
    const stroked = [];
    const context = { ...nothing, canvas, measureText: () => ({ width: 10 }), stroke({ points }) { stroked.push([this.strokeStyle, this.lineWidth, points]); } };
    lines.draw(context, { region, rad, area, css: 1, mirrored: false });
    return structuredClone({ lines: lines.drawn, stroked });
  };
  return { lines, paths, draw };
}

test("lines that have not moved are built once", () => {
  const { paths, draw } = drawing();
  const first = draw();
  const built = paths.built;
  assert.deepEqual(draw({ rad: 0.1 + STEERING_STEP_RAD / 10 }), first);
  assert.equal(paths.built, built);
  draw({ rad: 0.2 });
  assert.equal(paths.built, built + 1); // only the wheels' paths
});

test("lines follow the region, the size of the canvas, the steering and the optics", () => {
  const { lines, draw } = drawing();
  const first = draw();
  const changes = { region: { x: 160, y: 90, width: 320, height: 180 }, canvas: { width: 1280, height: 720 }, rad: -0.1 };
  for (const [what, value] of Object.entries(changes)) {
    const changed = draw({ [what]: value });
    assert.notDeepEqual(changed.lines, first.lines, what);
    assert.notDeepEqual(changed.stroked, first.stroked, what);
    assert.deepEqual(draw(), first, what);
  }
  const doubled = draw({ canvas: changes.canvas });
  assert.ok(Math.abs(doubled.lines[0].pieces[0][0].x - 2 * first.lines[0].pieces[0][0].x) < 1e-9);
  lines.setOptics({ ...CAMERA, fov_deg: 60 });
  assert.notDeepEqual(draw().stroked, first.stroked);
  lines.setOptics(CAMERA);
  assert.deepEqual(draw(), first);
  assert.equal(draw({ rad: null }).lines.some(({ kind }) => kind === "path"), false);
  assert.deepEqual(draw(), first);
});

test("all outlines are drawn before the lines", () => {
  const { stroked } = drawing().draw();
  const [outlines, lines] = [stroked.slice(0, 3), stroked.slice(3)];
  assert.deepEqual(lines.map(([colour]) => colour), Object.values(COLOURS));
  for (const [i, [colour, width, points]] of outlines.entries()) {
    assert.equal(colour, "rgba(0,0,0,0.55)");
    assert.ok(width > lines[i][1]);
    assert.deepEqual(points, lines[i][2]);
  }
});
