/**
 * Plays sound as steadily as its packets allow: waits for a buffer, conceals what is lost by repeating the last period of the
 * sound ever more quietly, and shortens a buffer that has become too long. Pure: times are those of the samples.
 */

export const RATE = 48_000;
export const TARGET_MS = 20;
const START_MS = 40; // buffered before it begins
const STEP = RATE / 100; // samples concealed at once where nothing is known of the lost packet: 10 ms
const DRY_STEPS = 6; // concealed so before there is silence
const DECAY = 0.75; // of what is concealed, each 10 ms
const FADE = RATE / 400; // samples of a cross-fade: 2.5 ms
const SHORTEST = RATE / 400, LONGEST = RATE / 60; // period that is looked for: of 400 to 60 Hz
const COARSE = 4; // samples between two that are compared, in a first look
const KEPT = 2 * LONGEST + FADE;
const WINDOW = 3 * RATE; // samples in which the least buffer counts
const SLACK_MS = 10; // by which a buffer may exceed its target
const EXCESS_MS = 200; // and beyond that all of it is dropped at once
const JUMP = 100; // packets: a larger gap is a new beginning

const ms = (samples) => (1000 * samples) / RATE;

/** @typedef {{number: number, captured: number, samples: Float32Array}} Chunk captured: ms, of its first sample */

export class Playout {
  /** @type {Chunk[]} */
  #queue = [];
  #target_ms = TARGET_MS;
  #isPlaying = false;
  #expected = NaN; // number of the next chunk
  /** @type {Float32Array|null} */
  #block = null; // being played; null: silence
  #at = 0;
  #captured = NaN; // of the first sample of that block
  #recent = new Float32Array(KEPT); // what was played last
  /** @type {{period: Float32Array, at: number, gain: number, steps: number}|null} */
  #concealing = null;
  #least = Infinity; // buffered samples, in this window
  #left = WINDOW; // samples until it ends
  #power = 0;
  #counted = 0;
  #isSkipping = false; // the next chunk does not follow the last one
  counts = { played: 0, concealed: 0, dry: 0, skipped: 0 };

  /** @param {Chunk} chunk */
  push(chunk) {
    const ahead = chunk.number - this.#expected;
    if (ahead < 0 && ahead > -JUMP) return; // its place has been concealed
    this.#queue.push(chunk);
  }

  /** Sound that comes latest is played so long after it has come; a longer time begins with silence. */
  set target_ms(value) {
    if (value > this.#target_ms + SLACK_MS) this.#isPlaying = false;
    this.#target_ms = value;
    this.#least = Infinity;
    this.#left = WINDOW;
  }

  get buffered_ms() {
    return ms(this.#buffered());
  }

  #buffered() {
    return this.#queue.reduce((sum, { samples }) => sum + samples.length, 0);
  }

  /** When the sample that is played next was captured, ms; NaN: there is silence. */
  get captured() {
    return this.#block && !this.#concealing ? this.#captured + ms(this.#at) : NaN;
  }

  /** Fill an output with the next samples. @param {Float32Array} out */
  pull(out) {
    for (let filled = 0; filled < out.length; ) {
      if (!this.#block || this.#at === this.#block.length) this.#next();
      const count = Math.min(out.length - filled, this.#block ? this.#block.length - this.#at : out.length);
      if (this.#block) out.set(this.#block.subarray(this.#at, this.#at + count), filled);
      else out.fill(0, filled, filled + count);
      this.#at += count;
      filled += count;
    }
    for (const sample of out) this.#power += sample * sample;
    this.#counted += out.length;
    this.#look(out.length);
  }

  /** The level since the last call, dB below full scale (RMS). */
  takeLevel() {
    const level = this.#counted ? 10 * Math.log10(this.#power / this.#counted + 1e-10) : -100;
    this.#power = this.#counted = 0;
    return level;
  }

  #next() {
    this.#remember(this.#block);
    this.#block = null;
    this.#at = 0;
    if (!this.#isPlaying && this.buffered_ms < Math.max(START_MS, this.#target_ms)) return;
    const isFirst = !this.#isPlaying;
    this.#isPlaying = true;
    const head = this.#queue[0];
    if (!head) return this.#runDry();
    const missing = head.number - this.#expected;
    if (missing > 0 && missing < JUMP && !isFirst) {
      this.#expected++;
      this.counts.concealed++;
      this.#block = this.#conceal(head.samples.length);
      return;
    }
    this.#queue.shift();
    this.#expected = head.number + 1;
    this.#captured = head.captured;
    this.counts.played++;
    this.#block = this.#joined(head.samples, isFirst);
  }

  #remember(block) {
    if (!block) return void this.#recent.fill(0);
    const kept = block.subarray(Math.max(0, block.length - KEPT));
    this.#recent.copyWithin(0, kept.length);
    this.#recent.set(kept, KEPT - kept.length);
  }

  #runDry() {
    if ((this.#concealing?.steps ?? 0) < DRY_STEPS) {
      this.#block = this.#conceal(STEP);
      return;
    }
    this.counts.dry++;
    this.#concealing = null;
    this.#isPlaying = false;
  }

  /** The sound as it would go on, ever more quietly. */
  #conceal(length) {
    this.#concealing ??= { period: lastPeriod(this.#recent), at: 0, gain: 1, steps: 0 };
    const own = this.#concealing;
    const block = new Float32Array(length);
    for (let i = 0; i < length; i++) block[i] = this.#goOn();
    own.steps += length / STEP;
    return block;
  }

  #goOn() {
    const own = this.#concealing;
    if (!own) return 0;
    const sample = own.period[own.at] * own.gain;
    own.at = (own.at + 1) % own.period.length;
    own.gain *= DECAY ** (1 / STEP);
    return sample;
  }

  /** A chunk that begins without a click, whatever was played before it. */
  #joined(samples, isFirst) {
    if (!isFirst && !this.#concealing && !this.#isSkipping) return samples;
    const joined = samples.slice();
    if (this.#isSkipping) this.#concealing ??= { period: lastPeriod(this.#recent), at: 0, gain: 1, steps: 0 };
    for (let i = 0; i < Math.min(FADE, joined.length); i++) {
      const share = (i + 1) / FADE;
      joined[i] = share * joined[i] + (1 - share) * this.#goOn();
    }
    this.#concealing = null;
    this.#isSkipping = false;
    return joined;
  }

  /** Shorten a buffer that was too long for a whole window. One too short grows by what is concealed meanwhile. */
  #look(passed) {
    this.#least = Math.min(this.#least, this.#buffered());
    this.#left -= passed;
    if (this.#left > 0) return;
    const excess_ms = this.#isPlaying ? ms(this.#least) - this.#target_ms : 0;
    if (excess_ms > SLACK_MS) {
      const packets = excess_ms / ms(this.#queue[0].samples.length);
      this.#skip(Math.max(1, Math.floor(excess_ms > EXCESS_MS ? packets : packets / 2)));
    }
    this.#least = Infinity;
    this.#left = WINDOW;
  }

  #skip(count) {
    const gone = this.#queue.splice(0, count);
    this.#expected = (gone.at(-1)?.number ?? this.#expected - 1) + 1;
    this.counts.skipped += gone.length;
    this.#isSkipping = true;
  }
}

/** The last period of a sound, by which it resembles itself most. @param {Float32Array} sound */
export function lastPeriod(sound) {
  const coarse = best(sound, SHORTEST, LONGEST, COARSE);
  const period = best(sound, Math.max(SHORTEST, coarse - COARSE), Math.min(LONGEST, coarse + COARSE), 1);
  return sound.slice(sound.length - period);
}

/** The shift, of those between two, by which the end of a sound resembles what was before it most. */
function best(sound, from, to, step) {
  let found = to;
  let most = -Infinity;
  for (let shift = from; shift <= to; shift += step) {
    let product = 0, power = 1e-9;
    for (let i = sound.length - LONGEST; i < sound.length; i += step) {
      product += sound[i] * sound[i - shift];
      power += sound[i - shift] * sound[i - shift];
    }
    const likeness = product / Math.sqrt(power);
    if (likeness > most) [most, found] = [likeness, shift];
  }
  return found;
}
