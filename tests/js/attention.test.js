/** An operator who looks elsewhere is told so on the return. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Attention } from "../../runner/page/static/attention.js";

const HERE = { hidden: false, focused: true };

test("nobody who stays is told anything", () => {
  const attention = new Attention();
  assert.equal(attention.changed(HERE, 0), null);
  assert.equal(attention.changed(HERE, 60_000), null);
  assert.equal(attention.warning, null);
});

test("out of focus is said at once, and for how long on the return", () => {
  const attention = new Attention();
  assert.equal(attention.changed({ hidden: false, focused: false }, 1000), null);
  assert.equal(attention.warning, "OUT OF FOCUS: keys do not reach this page; click it");
  assert.equal(attention.changed(HERE, 4100), "No key reached this page for 3 s");
  assert.equal(attention.warning, null);
});

test("a hidden page cannot be read: it speaks on the return", () => {
  const attention = new Attention();
  attention.changed({ hidden: false, focused: false }, 1000);
  attention.changed({ hidden: true, focused: false }, 1100);
  assert.equal(attention.warning, null);
  assert.equal(attention.changed({ hidden: false, focused: false }, 9000), null);
  assert.equal(attention.changed(HERE, 11_000), "This page was hidden for 10 s: look at every picture");
});

test("an absence counts from its own start, and a moment is not one", () => {
  const attention = new Attention();
  attention.changed({ hidden: true, focused: true }, 0);
  attention.changed(HERE, 5000);
  attention.changed({ hidden: false, focused: false }, 6000);
  assert.equal(attention.changed(HERE, 6400), null);
  attention.changed({ hidden: false, focused: false }, 7000);
  assert.equal(attention.changed(HERE, 7600), "No key reached this page for 1 s");
});

test("keys that reach another window of the page are not missing here, and pictures that nobody saw are", () => {
  const attention = new Attention();
  attention.changed({ hidden: false, focused: false, elsewhere: true }, 0);
  assert.equal(attention.state, "unfocused");
  assert.equal(attention.warning, null);
  assert.equal(attention.changed(HERE, 9000), null);
  attention.changed({ hidden: false, focused: false, elsewhere: false }, 10_000);
  assert.match(attention.warning ?? "", /OUT OF FOCUS/);
  assert.equal(attention.changed({ hidden: false, focused: false, elsewhere: true }, 12_000), "No key reached this page for 2 s");
  attention.changed({ hidden: true, focused: false, elsewhere: true }, 13_000);
  assert.equal(attention.changed({ hidden: false, focused: false, elsewhere: true }, 16_000), "This page was hidden for 3 s: look at every picture");
});

const STATES = [
  [{ hidden: false, focused: true }, "watching", null],
  [{ hidden: false, focused: false }, "unfocused", /OUT OF FOCUS/],
  [{ hidden: false, focused: true, slow: true }, "slow", /SLOW/],
  [{ hidden: false, focused: false, slow: true }, "slow", /SLOW/],
  [{ hidden: true, focused: true }, "hidden", null],
  [{ hidden: true, focused: false, slow: true }, "hidden", null],
];
for (const [page, state, warning] of STATES)
  test(`the worst is told, and warned of where it can be seen: ${JSON.stringify(page)}`, () => {
    const attention = new Attention();
    attention.changed(/** @type {any} */ (page), 0);
    assert.equal(attention.state, state);
    if (warning) assert.match(attention.warning ?? "", /** @type {RegExp} */ (warning));
    else assert.equal(attention.warning, null);
  });
