import assert from "node:assert/strict";
import { test } from "node:test";

import { WHOLE } from "../../runner/page/static/framing.js";
import { COLOURS, GuideLines, STEERING_STEP_RAD, withoutStraight } from "../../runner/page/static/guide_lines.js";
import { onPageReady } from "../../runner/page/static/resizing.js";

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
/** As a canvas has its size: not in properties of its own. */
const sized = (width, height) => Object.create({ width, height });
const DISPLAY = { width: 640, height: 360, ratio: 1, view: WHOLE };
const SHOWN = { region: { x: 0, y: 0, width: 640, height: 360 }, rad: 0.1, picture: sized(640, 360), display: DISPLAY };

/** Draws into a canvas of 640x360 px that records how many paths were built, and returns what was drawn, in order. */
function drawing() {
  const paths = { built: 0 };
  globalThis.Path2D = class {
    points = [];
    constructor() { paths.built++; }
    moveTo(x, y) { this.points.push([x, y]); }
    lineTo(x, y) { this.points.push([x, y]); }
  };
  globalThis.postMessage = () => {};
  const calls = [];
  const context = {
    canvas: { width: 640, height: 360 },
    ...Object.fromEntries(["save", "beginPath", "rect", "clip", "restore"].map((name) => [name, () => {}])),
    measureText: () => ({ width: 10 }),
    strokeText: () => {},
    clearRect: () => calls.push(["clear"]),
    fillText: (words, x, y) => calls.push(["words", words, x, y]),
    stroke({ points }) { calls.push(["stroke", this.strokeStyle, this.lineWidth, points]); },
  };
  const lines = new GuideLines(CAMERA, DIMENSIONS);
  lines.attach({ getContext: () => context });
  lines.shown = true;
  /** What a drawing adds to the canvas; all of it is drawn again unless `kept`. */
  const draw = (changes = {}, kept = false) => {
    if (!kept) lines.drawn = [];
    calls.length = 0;
    lines.draw(changes && { ...SHOWN, ...changes });
    return structuredClone({ lines: lines.drawn, stroked: calls.filter(([what]) => what === "stroke").map(([, ...how]) => how), calls });
  };
  return { lines, paths, context, draw };
}

test("lines that have not moved are drawn once", () => {
  const { paths, draw } = drawing();
  const first = draw();
  const built = paths.built;
  const again = draw({ rad: 0.1 + STEERING_STEP_RAD / 10 }, true);
  assert.deepEqual(again.lines, first.lines);
  assert.deepEqual(again.calls, []);
  assert.equal(paths.built, built);
  assert.deepEqual(draw({ rad: 0.2 }, true).calls.at(0), ["clear"]);
  assert.equal(paths.built, built + 1); // only the wheels' paths
});

test("lines disappear with what they belong to, and return", () => {
  const { lines, draw } = drawing();
  const first = draw();
  assert.deepEqual(draw(null, true).calls, [["clear"]]);
  assert.deepEqual(draw(null, true).calls, []);
  assert.deepEqual(draw({}, true).stroked, first.stroked);
  lines.shown = false;
  assert.deepEqual(draw({}, true).calls, [["clear"]]);
});

test("a canvas that keeps an old size for now shows no lines", () => {
  const { lines, draw } = drawing();
  draw();
  const larger = { display: { ...DISPLAY, width: 1280, height: 720 } };
  assert.deepEqual(draw(larger, true).calls, [["clear"]]);
  assert.ok(lines.isResizeDue);
  onPageReady(() => assert.ok(draw(larger, true).stroked.length));
  assert.ok(!lines.isResizeDue);
});

test("lines follow the region, the box, the steering and the optics", () => {
  const { lines, draw } = drawing();
  const first = draw();
  const mirrored = { ...DISPLAY, view: { ...WHOLE, mirrored: true } };
  for (const [what, value] of Object.entries({ region: { x: 160, y: 90, width: 320, height: 180 }, rad: -0.1, display: mirrored })) {
    const changed = draw({ [what]: value });
    assert.notDeepEqual(changed.lines, first.lines, what);
    assert.notDeepEqual(changed.stroked, first.stroked, what);
    assert.deepEqual(draw(), first, what);
  }
  lines.setOptics({ ...CAMERA, fov_deg: 60 });
  assert.notDeepEqual(draw().stroked, first.stroked);
  lines.setOptics(CAMERA);
  assert.deepEqual(draw(), first);
  assert.equal(draw({ rad: null }).lines.some(({ kind }) => kind === "path"), false);
  assert.deepEqual(draw(), first);
});

test("lines and words have the resolution of the screen, however few px the picture has", () => {
  const { context, draw } = drawing();
  const first = draw();
  assert.deepEqual(draw({ picture: sized(160, 90) }).calls, first.calls);
  Object.assign(context.canvas, { width: 1280, height: 720 }); // on a screen with two px per CSS px
  const sharp = draw({ display: { ...DISPLAY, ratio: 2 } });
  for (const [i, { pieces }] of first.lines.entries())
    for (const [j, piece] of pieces.entries())
      for (const [k, { x, y }] of piece.entries()) {
        const at = sharp.lines[i].pieces[j][k];
        assert.ok(Math.hypot(at.x - 2 * x, at.y - 2 * y) < 1e-9);
      }
  assert.ok(first.calls.filter(([what]) => what === "words").length >= 3);
  assert.ok(sharp.stroked.every(([, width], i) => Math.abs(width - 2 * first.stroked[i][1]) < 1e-9));
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
