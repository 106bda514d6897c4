import assert from "node:assert/strict";
import { test } from "node:test";
import { lastPeriod, Playout, RATE, TARGET_MS } from "../../runner/page/static/playout.js";
import { Step, waitFor } from "../../runner/page/static/hearing.js";

const LENGTH = RATE / 50; // samples of a packet
const HZ = 440;

const tone = (number) => Float32Array.from({ length: LENGTH }, (_, i) => 0.5 * Math.sin((2 * Math.PI * HZ * (number * LENGTH + i)) / RATE));
const chunk = (number) => ({ number, captured: 1000 + 20 * number, samples: tone(number) });

/** What is played of so many milliseconds, in the quanta of the browser. */
function played(playout, ms) {
  const out = new Float32Array(128 * Math.floor((RATE * ms) / 1000 / 128));
  for (let at = 0; at < out.length; at += 128) playout.pull(out.subarray(at, at + 128));
  return out;
}

/**
 * Push packets and play as much as each holds; returns what was played.
 * @param {{from?: number, comes?: (number: number) => boolean}} [how]
 */
function drive(playout, to, { from = 0, comes = () => true } = {}) {
  const out = new Float32Array(128 * Math.ceil(((to - from) * LENGTH) / 128));
  for (let number = from, at = 0; number < to; number++) {
    if (comes(number)) playout.push(chunk(number));
    for (; at < (number + 1 - from) * LENGTH; at += 128) playout.pull(out.subarray(at, at + 128));
  }
  return out;
}

const rms = (samples) => Math.sqrt(samples.reduce((sum, each) => sum + each * each, 0) / samples.length);
const steepest = (samples) => samples.reduce((most, each, i) => Math.max(most, i ? Math.abs(each - samples[i - 1]) : 0), 0);
const STEEPEST = 0.5 * ((2 * Math.PI * HZ) / RATE);

test("it waits for two packets, then plays every sample", () => {
  const playout = new Playout();
  playout.push(chunk(0));
  assert.equal(rms(played(playout, 20)), 0);
  playout.push(chunk(1));
  playout.push(chunk(2));
  const out = played(playout, 30);
  assert.ok(rms(out) > 0.3);
  assert.ok(steepest(out) <= 1.1 * STEEPEST); // it begins without a click
  assert.ok(Math.abs(playout.captured - 1030) < 3);
});

test("a lost packet is no gap: a tone keeps its level, and there is no click", () => {
  const playout = new Playout();
  const out = drive(playout, 200, { comes: (number) => number % 50 !== 25 }).subarray(RATE / 5);
  assert.equal(playout.counts.concealed, 4);
  assert.equal(playout.counts.dry, 0);
  const windows = Array.from({ length: Math.floor(out.length / 480) }, (_, i) => rms(out.subarray(480 * i, 480 * (i + 1))));
  assert.ok(Math.min(...windows) > 0.5 * rms(tone(0)), String(Math.min(...windows)));
  assert.ok(steepest(out) < 4 * STEEPEST, String(steepest(out)));
});

test("what is concealed for long becomes quiet, then silent, and goes on where sound comes again", () => {
  const playout = new Playout();
  drive(playout, 10);
  const out = played(playout, 300);
  assert.equal(rms(out.subarray(out.length - 4800)), 0);
  assert.equal(playout.counts.dry, 1);
  for (let number = 10; number < 14; number++) playout.push(chunk(number));
  assert.ok(rms(played(playout, 40)) > 0.3);
});

test("a packet that is too late for its place is not played", () => {
  const playout = new Playout();
  drive(playout, 20, { comes: (number) => number !== 10 });
  playout.push(chunk(10));
  played(playout, 100);
  assert.equal(playout.counts.played, 19);
});

test("a buffer that stays too long is shortened, slowly or at once", () => {
  const slow = new Playout();
  for (let number = 0; number < 6; number++) slow.push(chunk(number));
  drive(slow, 300, { from: 6 });
  assert.ok(slow.counts.skipped >= 2 && slow.buffered_ms < TARGET_MS + 80, String(slow.buffered_ms));
  const burst = new Playout();
  for (let number = 0; number < 40; number++) burst.push(chunk(number));
  drive(burst, 220, { from: 40 });
  assert.ok(burst.buffered_ms < TARGET_MS + 80, String(burst.buffered_ms));
});

test("sound does not wait for a picture that stands still for a moment", () => {
  const step = new Step();
  const look = (ahead_ms, from, to) => {
    for (let now = from; now < to; now += 250) step.look(typeof ahead_ms === "function" ? ahead_ms(now) : ahead_ms, now);
    return step.target_ms;
  };
  assert.equal(look((now) => (now % 2000 < 1000 ? 1500 : -100), 0, 20_000), TARGET_MS);
  assert.equal(look(null, 20_000, 30_000), TARGET_MS); // it does not move
  assert.equal(look(200, 30_000, 33_500), TARGET_MS + 140); // it has been older for a whole window
});

test("a stream that begins anew is played at once", () => {
  const playout = new Playout();
  drive(playout, 10);
  for (let number = 1000; number < 1004; number++) playout.push({ ...chunk(number), captured: number });
  played(playout, 100);
  assert.ok(playout.captured >= 1000 || playout.counts.played > 12);
  assert.equal(playout.counts.concealed, 0);
});

test("the level is that of the samples", () => {
  const playout = new Playout();
  drive(playout, 50);
  playout.takeLevel();
  for (let number = 50; number < 60; number++) playout.push(chunk(number));
  played(playout, 100);
  assert.ok(Math.abs(playout.takeLevel() - 20 * Math.log10(0.5 / Math.SQRT2)) < 0.5);
});

test("the period of a sound is found", () => {
  const sound = Float32Array.from({ length: 2000 }, (_, i) => Math.sin((2 * Math.PI * i) / 300) + 0.5 * Math.sin((4 * Math.PI * i) / 300));
  assert.equal(lastPeriod(sound).length, 300);
});

test("sound waits for a picture that is more than 80 ms older, and no longer than it must", () => {
  assert.equal(waitFor(TARGET_MS, null), TARGET_MS);
  assert.equal(waitFor(TARGET_MS, 80), TARGET_MS);
  assert.equal(waitFor(60, 200), 200); // then it is 60 ms ahead
  assert.equal(waitFor(200, 60), 200);
  assert.equal(waitFor(200, 30), 180);
  assert.equal(waitFor(1000, -800), 160); // pictures are young again
  assert.equal(waitFor(TARGET_MS, -100), TARGET_MS); // pictures never wait
  assert.equal(waitFor(60, 5000), 1000);
});
