/** What the microphone hears, on the browser's audio thread: in pieces of 10 ms to the worker, while a key is held. */

const RATE = 48_000;
const COUNT = RATE / 100; // samples of a piece
const HEAD_BYTES = 16; // when it was spoken, s, by the clock of this audio thread, and which one that is: a random number
const FULL = 32_767;

class Talking extends AudioWorkletProcessor {
  #isHeld = false;
  #piece = new DataView(new ArrayBuffer(HEAD_BYTES + 2 * COUNT));
  #filled = 0;
  /** @type {MessagePort|null} */
  #worker = null;

  constructor() {
    super();
    this.#piece.setFloat64(8, Math.random(), true);
    this.port.onmessage = ({ data: { worker, held } }) => {
      this.#worker = worker ?? this.#worker;
      this.#isHeld = held ?? this.#isHeld;
      this.#filled = 0;
    };
  }

  process([[samples = []]]) {
    if (!this.#isHeld) return true;
    for (const sample of samples) {
      if (this.#filled === 0) this.#piece.setFloat64(0, currentTime, true);
      this.#piece.setInt16(HEAD_BYTES + 2 * this.#filled, Math.round(Math.max(-1, Math.min(1, sample)) * FULL), true);
      if (++this.#filled === COUNT) this.#send();
    }
    return true;
  }

  #send() {
    this.#worker?.postMessage(this.#piece.buffer.slice(0));
    this.#filled = 0;
  }
}

registerProcessor("talking", Talking);
