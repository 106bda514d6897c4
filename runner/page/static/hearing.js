/**
 * The vehicle's sound in the worker: decodes its packets, and hands the samples to the browser's audio thread, past the
 * page's main thread. Sound is delayed so that it is not ahead of the main picture by more than 80 ms.
 */

import { TARGET_MS } from "./playout.js";

export const SOUND = 255; // in place of a camera's index
const CONFIG = { codec: "opus", sampleRate: 48_000, numberOfChannels: 1 };
const MOST_AHEAD_MS = 80; // of the main picture, the front camera's unless another is enlarged
const NEAR_MS = 40; // once it is ahead by less, it need not wait
const STEP_MS = 20; // by which a delay changes at least
const MOST_MS = 1000; // that sound waits for a picture
const WINDOW_MS = 3000; // in which the least lead counts: a picture that stands still for a moment does not delay sound
const SETTLE_MS = 500; // after a change, before the next window
const STALE_MS = 500; // since the audio thread's last report

/**
 * How long sound is to wait, ms.
 * @param {number} target_ms so far
 * @param {number|null} ahead_ms by how much what is heard was captured after what is seen; null: unknown
 */
export function waitFor(target_ms, ahead_ms) {
  if (ahead_ms === null) return target_ms;
  if (ahead_ms > MOST_AHEAD_MS) return Math.min(MOST_MS, target_ms + ahead_ms - NEAR_MS - STEP_MS);
  return ahead_ms < NEAR_MS ? Math.max(TARGET_MS, target_ms - Math.max(STEP_MS, NEAR_MS - ahead_ms)) : target_ms;
}

/** How long sound waits, by its lead over the pictures, which jumps where a picture was lost. Times are ms. */
export class Step {
  target_ms = TARGET_MS;
  #least = Infinity; // lead in this window
  #began = NaN;

  /** @param {number|null} ahead_ms as of `waitFor`  @param {number} now */
  look(ahead_ms, now) {
    if (Number.isNaN(this.#began)) this.#began = now;
    if (ahead_ms !== null && now >= this.#began) this.#least = Math.min(this.#least, ahead_ms);
    if (now - this.#began < WINDOW_MS) return;
    const before = this.target_ms;
    if (this.#least < Infinity) this.target_ms = waitFor(before, this.#least);
    this.#began = this.target_ms === before ? now : now + SETTLE_MS;
    this.#least = Infinity;
  }
}

export class Hearing {
  #clock;
  #onFailure;
  /** @type {AudioDecoder|null} */
  #decoder = null;
  /** @type {MessagePort|null} */
  #port = null;
  #isRunning = false;
  #latency_ms = 0; // from the audio thread to the ear
  #decoded = 0; // packets given to the decoder
  /** @type {{number: number, captured: number}[]} */
  #waiting = []; // of packets in the decoder, which itself ignores times after the first one
  #played = { at: -Infinity, level_db: -100, buffered_ms: 0, counts: null };
  #heard = { at: -Infinity, age_ms: NaN }; // the same, of sound that was not concealed
  #step = new Step();

  /** @param {import("./clock.js").Clock} clock  @param {(why: string) => void} onFailure */
  constructor(clock, onFailure) {
    this.#clock = clock;
    this.#onFailure = onFailure;
  }

  /** @param {MessagePort|undefined} port of the audio thread; undefined: as before */
  attach(port, isRunning, latency_ms) {
    if (port) {
      this.#port = port;
      port.onmessage = ({ data }) => this.#onPlayed(data);
    }
    if (isRunning && !this.#isRunning) this.#reset();
    this.#isRunning = isRunning;
    this.#latency_ms = latency_ms;
  }

  #onPlayed({ captured, level_db, buffered_ms, counts }) {
    const at = performance.now();
    this.#played = { at, level_db, buffered_ms, counts };
    const age_ms = this.#clock.toStation(performance.timeOrigin + at) + this.#latency_ms - captured;
    if (Number.isFinite(age_ms)) this.#heard = { at, age_ms };
  }

  #reset() {
    if (this.#decoder && this.#decoder.state !== "closed") this.#decoder.close();
    this.#decoder = null;
    this.#waiting = [];
  }

  /** A packet has come. captured: ms on the station's clock. */
  receive({ sequence, captured, data }) {
    if (!this.#port || !this.#isRunning) return;
    this.#decoder ??= this.#build();
    this.#waiting.push({ number: sequence, captured });
    this.#decoder.decode(new EncodedAudioChunk({ type: "key", timestamp: this.#decoded++ * 20_000, data }));
  }

  #build() {
    const decoder = new AudioDecoder({
      output: (audio) => this.#onDecoded(audio),
      error: (error) => {
        this.#onFailure(error.message);
        this.#reset();
      },
    });
    decoder.configure(CONFIG);
    return decoder;
  }

  /** @param {AudioData} audio */
  #onDecoded(audio) {
    const own = this.#waiting.shift();
    const samples = new Float32Array(audio.numberOfFrames);
    audio.copyTo(samples, { planeIndex: 0, format: "f32-planar" });
    audio.close();
    if (own) this.#port?.postMessage({ ...own, samples }, [samples.buffer]);
  }

  /**
   * What is heard now, and whether it is in step with a picture; a few times a second.
   * @param {number|null} picture_ms age of the main picture; null: unknown, or it does not move
   */
  report(picture_ms) {
    const { at, level_db, buffered_ms, counts } = this.#played;
    const isRecent = (since) => this.#isRunning && performance.now() - since < STALE_MS;
    const isHeard = isRecent(at);
    const age_ms = isRecent(this.#heard.at) ? this.#heard.age_ms : null;
    const ahead_ms = age_ms === null || picture_ms === null ? null : picture_ms - age_ms;
    this.#keepStep(ahead_ms);
    return { age_ms, ahead_ms, level_db: isHeard ? level_db : null, buffered_ms, target_ms: this.#step.target_ms, counts };
  }

  #keepStep(ahead_ms) {
    const before = this.#step.target_ms;
    this.#step.look(ahead_ms, performance.now());
    const { target_ms } = this.#step;
    if (target_ms !== before) this.#port?.postMessage({ target_ms });
  }
}
