/** Places of the Drive view, and how a camera moves from one to another. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { rolesOf } from "../../runner/page/static/arrange.js";
import { moved, placeAt, placeOf, placesOf, placeText, shifted, stated } from "../../runner/page/static/placing.js";

const camera = (name, yaw_deg, pitch_deg = 0) => ({ name, width: 16, height: 9, framing: null, pose: { yaw_deg, pitch_deg } });
const CAMERAS = [camera("ahead", 0), camera("left", 50), camera("back", 180), camera("top", 0, 60), camera("top_2", 90, 60)];
const PLACES = { front: "ahead", left: "left", right: null, rear: "back", row: ["top", "top_2"] };

/** All cameras of some places, sorted. */
const names = ({ row, ...singles }) => [...Object.values(singles).filter(Boolean), ...row].sort();

test("they begin as the poses have them", () => {
  assert.deepEqual(placesOf(rolesOf(CAMERAS)), PLACES);
  assert.deepEqual(stated(PLACES), { front: "ahead", left: "left", rear: "back", row: ["top", "top_2"] });
});

test("saved places have priority over poses; cameras without a place follow at the end of the row, unknown ones are left out", () => {
  const roles = rolesOf(CAMERAS, { front: "top", rear: "gone", row: ["back", "ahead", "gone"] });
  assert.deepEqual(placesOf(roles), { front: "top", left: null, right: null, rear: null, row: ["back", "ahead", "left", "top_2"] });
  assert.deepEqual(placesOf(rolesOf(CAMERAS, { front: "gone", left: "top" })), PLACES, "without its front camera a layout does not apply");
});

test("two cameras swap places", () => {
  assert.deepEqual(moved(PLACES, "left", "front"), { ...PLACES, front: "left", left: "ahead" });
  assert.deepEqual(moved(PLACES, "top", "front"), { ...PLACES, front: "top", row: ["ahead", "top_2"] });
  assert.deepEqual(moved(PLACES, "ahead", "rear"), { ...PLACES, front: "back", rear: "ahead" });
});

test("a camera goes to an empty place, and leaves its own empty", () => {
  assert.deepEqual(moved(PLACES, "left", "right"), { ...PLACES, left: null, right: "left" });
  assert.deepEqual(moved(PLACES, "top", "right"), { ...PLACES, right: "top", row: ["top_2"] });
  assert.deepEqual(moved(PLACES, "back", "row"), { ...PLACES, rear: null, row: ["top", "top_2", "back"] });
  assert.deepEqual(moved(PLACES, "back", "row", 1).row, ["top", "back", "top_2"]);
});

test("the front is never empty", () => {
  for (const to of ["right", "row"]) assert.deepEqual(moved(PLACES, "ahead", to), PLACES);
});

test("pictures change their order in the row", () => {
  assert.deepEqual(shifted(PLACES, "top", 1).row, ["top_2", "top"]);
  for (const [name, step] of [["top", -1], ["top_2", 1], ["left", 1]]) assert.deepEqual(shifted(PLACES, name, step), PLACES);
});

test("no move loses a camera or shows one twice", () => {
  for (const name of names(PLACES))
    for (const to of ["front", "left", "right", "rear", "row"]) {
      const after = moved(PLACES, name, to);
      assert.deepEqual(names(after), names(PLACES), `${name} to ${to}`);
      if (name !== "ahead" || ["front", "left", "rear"].includes(to)) assert.equal(placeOf(after, name), to);
      assert.deepEqual(placesOf(rolesOf(CAMERAS, stated(after))), after);
    }
});

test("a point is in the place whose slot it is in, otherwise in the front", () => {
  const slot = (x, y) => ({ x, y, width: 100, height: 80 });
  const slots = { front: slot(0, 80), left: slot(0, 0), rear: slot(100, 0), right: slot(200, 0), row: slot(300, 0) };
  const found = [[50, 40], [150, 0], [299, 79], [300, 40], [50, 100]].map(([x, y]) => placeAt(x, y, slots));
  assert.deepEqual(found, ["left", "rear", "right", "row", "front"]);
});

test("places have names", () => {
  assert.deepEqual(["ahead", "left", "back", "top_2"].map((name) => placeText(PLACES, name)), ["middle", "left", "mirror", "row, number 2"]);
});
