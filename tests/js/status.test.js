/** The status of a tile's stream, from times alone. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { alarmText, judge, keyText, slowText } from "../../runner/page/static/status.js";

const NOW = 100_000;
const LIMITS = { frozen_ms: 120 };
const LIVE = {
  connected: true, online: true, on: true, sending: true, refused: "", drawn: true, stood_since: null, wave_s: 1.5, begins: false, damaged: false, faulty: false,
  arrived: NOW - 20, decoded: NOW - 10, late_until: 0, fps: 40,
};
const judged = (more) => judge({ ...LIVE, ...more }, LIMITS, NOW);

test("a stream whose pictures arrive is live", () => assert.equal(judged({}), "live"));

const CASES = [
  ["ended", { connected: false, ended: true }],
  ["ended", { connected: false, ended: true, on: false, arrived: NOW - 5000 }],
  ["off", { on: false }],
  ["off", { on: false, sending: false, arrived: NOW - 5000 }], // the silence was requested
  ["paused", { sending: false }],
  ["lost", { sending: false, unopened: true }],
  ["lost", { connected: false }],
  ["lost", { online: false }],
  ["lost", { connected: false, on: false }], // the state of an unreachable camera is unknown
  ["lost", { arrived: NOW - 1001 }],
  ["frozen", { arrived: NOW - 1000 }],
  ["frozen", { begins: true, arrived: NOW - 3000 }], // a stream that starts may take longer to its first unit
  ["lost", { begins: true, arrived: NOW - 3001 }],
  ["refused", { declined: true, arrived: NOW - 5000 }], // by the vehicle, which says why: not lost
  ["lost", { declined: true, online: false }],
  ["off", { declined: true, on: false }],
  ["unsupported", { refused: "no decoder" }],
  ["lost", { refused: "no decoder", arrived: NOW - 1001 }],
  ["synchronising", { drawn: false }],
  ["synchronising", { drawn: false, waits_since: NOW - 4000 }],
  ["synchronising", { drawn: false, waits_since: NOW - 5000 }],
  ["frozen", { drawn: false, waits_since: NOW - 5001 }], // two refresh waves, and 2 s for the decoder
  ["synchronising", { drawn: false, waits_since: NOW - 12_000, wave_s: 5 }],
  ["frozen", { drawn: false, waits_since: NOW - 12_001, wave_s: 5 }],
  ["frozen", { drawn: false, waits_since: NOW - 5001, wave_s: null }],
  ["frozen", { drawn: false, waits_since: NOW - 15_001, wave_s: 60 }],
  ["live", { drawn: false, stood_since: NOW - 120 }], // the decoder restarts: the last picture is still recent,
  ["frozen", { drawn: false, stood_since: NOW - 121 }], // and then it stands, although units arrive
  ["live", { stood_since: NOW - 5000 }], // pictures are drawn again
  ["frozen", { arrived: NOW - 121 }],
  ["live", { arrived: NOW - 120 }],
  ["frozen", { decoded: NOW - 121 }], // units arrive but are not decoded
  ["late", { late_until: NOW + 1 }],
  ["live", { late_until: NOW }],
  ["frozen", { late_until: NOW + 1, arrived: NOW - 500 }],
  ["damaged", { damaged: true }],
  ["damaged", { damaged: true, late_until: NOW + 1 }],
  ["frozen", { damaged: true, arrived: NOW - 500 }],
  ["frozen", { faulty: true }], // pictures arrive, but may all be the same one
  ["off", { faulty: true, on: false }],
];
for (const [status, more] of CASES) test(`${status}: ${JSON.stringify(more)}`, () => assert.equal(judged(more), status));

test("a slow camera freezes after 1.3 frame intervals, not after the limit of fast ones", () => {
  assert.equal(judged({ fps: 5, arrived: NOW - 260 }), "live");
  assert.equal(judged({ fps: 5, arrived: NOW - 261 }), "frozen");
});

test("alarms state how long and how late", () => {
  assert.equal(alarmText("frozen", 450, NaN), "FROZEN 0.4 s");
  for (const [since, text] of [[120, "0.1"], [217, "0.2"], [299, "0.2"], [300, "0.3"], [1049, "1.0"]])
    assert.equal(alarmText("frozen", since, NaN), `FROZEN ${text} s`);
  assert.equal(alarmText("late", 0, 313), "LATE 310 ms");
  assert.equal(alarmText("lost", 3999, NaN), "LOST 3 s");
  assert.equal(alarmText("lost", 1e9, NaN), "LOST");
  assert.equal(alarmText("unsupported", 0, NaN), "NO PICTURE");
  assert.equal(alarmText("synchronising", 0, NaN), "SYNCHRONISING");
});

test("a camera of a low rate is live between its pictures, and says its rate", () => {
  const between = { arrived: NOW - 240, decoded: NOW - 235 };
  assert.equal(judged(between), "frozen");
  assert.equal(judged({ ...between, fps: 4 }), "live");
  assert.equal(slowText(12, 40), "12 of 40 Hz");
  assert.equal(slowText(12, 30000 / 1001), "12 of 29.97 Hz");
});

test("a wait for a key picture is counted in whole seconds", () => {
  assert.equal(keyText(900), "WAITING FOR KEY PICTURE 0 s");
  assert.equal(keyText(3100), "WAITING FOR KEY PICTURE 3 s");
});
