/** When there is no time to draw every picture, the front camera's comes first and no other camera starves. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { drawInTurn } from "../../runner/page/static/turns.js";

/** Cameras whose pictures take so many ms to draw, and a function that draws for one frame and returns their names. */
function cameras(takes) {
  let time = 1000;
  let drawn = [];
  const streams = Object.entries(takes).map(([name, ms]) => ({
    name,
    isWaiting: true,
    last_drawn: 0,
    draw() {
      time += ms;
      Object.assign(this, { isWaiting: false, last_drawn: time });
      drawn.push(name);
    },
  }));
  const frame = (first) => {
    drawn = [];
    time += 1;
    return [drawInTurn(streams, first, () => time), ...drawn];
  };
  const arrive = (...names) => streams.forEach((stream) => (stream.isWaiting ||= names.includes(stream.name)));
  return { frame, arrive };
}

test("when there is time all are drawn, the first camera's picture first", () => {
  const { frame, arrive } = cameras({ left: 1, front: 1, rear: 1 });
  assert.deepEqual(frame("front"), [false, "front", "left", "rear"]);
  arrive("rear");
  assert.deepEqual(frame("front"), [false, "rear"]);
  assert.deepEqual(frame("front"), [false]);
});

test("otherwise the first is drawn in every frame and the others take turns", () => {
  const { frame, arrive } = cameras({ left: 7, front: 7, right: 7, rear: 7 });
  const seen = [];
  for (let i = 0; i < 6; i++) {
    const [waits, first, ...others] = frame("front");
    assert.equal(waits, true, "pictures still wait");
    assert.equal(first, "front");
    seen.push(...others);
    arrive("left", "front", "right", "rear");
  }
  assert.deepEqual(seen, ["left", "right", "rear", "left", "right", "rear"]);
});

test("slow drawing starves no camera", () => {
  const { frame, arrive } = cameras({ front: 40, left: 40, right: 40 });
  const seen = new Set();
  for (let i = 0; i < 4; i++, arrive("front", "left", "right")) frame("front").forEach((each) => seen.add(each));
  assert.deepEqual([...seen], [true, "front", "left", "right"]);
});

test("the picture that has waited longest is drawn next, whatever the order of the cameras", () => {
  const { frame, arrive } = cameras({ front: 1, left: 20, right: 20 });
  assert.deepEqual(frame("front"), [true, "front", "left"]);
  arrive("left", "front");
  assert.deepEqual(frame("front"), [true, "front", "right"]);
  assert.deepEqual(frame("front"), [false, "left"]);
});

test("without a first camera all take turns", () => {
  const { frame } = cameras({ left: 20, right: 20 });
  assert.deepEqual(frame(null), [true, "left"]);
  assert.deepEqual(frame("none of them"), [false, "right"]);
});
