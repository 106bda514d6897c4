/** Buttons and keys: a press counts once, however long it lasts. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { actionOf, keyOf, Presses } from "../../runner/page/static/presses.js";

const pad = (held, index = 0) => ({ index, buttons: [0, 1, 2, 3].map((button) => ({ pressed: held.includes(button) })) });
const polled = (presses, ...steps) => steps.map((pads) => presses.poll(pads));

test("a press counts once, and again after the button was released", () => {
  assert.deepEqual(polled(new Presses(), [pad([])], [pad([1])], [pad([1])], [pad([1, 3])], [pad([3])], [pad([1, 3])]), [[], [1], [], [3], [], [1]]);
});

test("a button that is held when a pad connects, or reconnects, does not count", () => {
  assert.deepEqual(polled(new Presses(), [pad([2])], [pad([2])], [], [pad([1])], [pad([1, 2])]), [[], [], [], [], [2]]);
});

test("each pad has buttons of its own, and the same button on two pads counts once", () => {
  const [wheel, stick] = [(held) => pad(held, 0), (held) => pad(held, 3)];
  assert.deepEqual(polled(new Presses(), [wheel([]), stick([])], [wheel([1]), stick([])], [wheel([1]), stick([1])], [wheel([1]), stick([])]), [[], [1], [1], []]);
  assert.deepEqual(polled(new Presses(), [wheel([]), stick([])], [wheel([2]), stick([2])]), [[], [2]]);
});

test("a button pressed while the page was out of focus does not count", () => {
  const presses = new Presses();
  presses.poll([pad([])]);
  presses.reset();
  assert.deepEqual(polled(presses, [pad([0])], [pad([0, 1])]), [[], [1]]);
});

test("the ends of an axis and the directions of a cross are buttons, too", () => {
  const wheel = (...axes) => [{ index: 0, buttons: [], axes }];
  assert.deepEqual(polled(new Presses(), wheel(0, 1), wheel(-1, 1), wheel(-0.4, 0), wheel(0.1, -0.6), wheel(0, -0.4), wheel(0, -0.6), wheel(0, -0.2), wheel(0, -0.6)), [[], ["axis0-", "hat0-up"], [], ["axis1-"], [], [], [], ["axis1-"]]);
  const cross = [9 / 7, -1, -5 / 7, -3 / 7, 1 / 7, 5 / 7, 1]; // nothing, up, up and right, right, down, left, left and up
  const hats = polled(new Presses(), ...cross.map((value) => wheel(value))).map((names) => names.filter((name) => name.startsWith("hat")));
  assert.deepEqual(hats, [[], ["hat0-up"], [], ["hat0-right"], ["hat0-down"], ["hat0-left"], []]);
});

test("an action is found by its key or button; null is none", () => {
  const buttons = { view: 3, back: 0, theme: null };
  assert.deepEqual([3, 0, 7].map((button) => actionOf(buttons, button)), ["view", "back", undefined]);
});

const KEYS = [
  ["v", false, "v"],
  ["V", false, "v"], // Caps Lock
  ["V", true, "V"],
  ["v", true, "V"], // Caps Lock and Shift
  ["?", true, "?"],
  ["ArrowLeft", false, "ArrowLeft"],
  ["Ä", false, "ä"],
];
for (const [key, shiftKey, name] of KEYS) test(`key ${key}${shiftKey ? " with Shift" : ""} is ${name}`, () => assert.equal(keyOf(/** @type {any} */ ({ key, shiftKey })), name));
