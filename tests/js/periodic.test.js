import assert from "node:assert/strict";
import { mock, test } from "node:test";

import { checkRegularly } from "../../runner/page/static/periodic.js";

test("a check is left out just after the page has stalled", () => {
  mock.timers.enable({ apis: ["setInterval"] });
  let time = 0;
  mock.method(performance, "now", () => time);
  const checked = [];
  checkRegularly(100, (now) => checked.push(now));
  for (const ms of [100, 200, 900, 1000, 1100]) {
    time = ms;
    mock.timers.tick(100);
  }
  mock.reset();
  assert.deepEqual(checked, [100, 200, 1000, 1100]);
});
