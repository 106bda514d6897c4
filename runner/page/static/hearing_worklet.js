/** The vehicle's sound on the browser's audio thread. Its samples come from the worker, see hearing.js. */

import { Playout } from "./playout.js";

const REPORT_S = 0.1;

class Hearing extends AudioWorkletProcessor {
  #playout = new Playout();
  #reported = 0;
  /** @type {MessagePort|null} */
  #worker = null;

  constructor() {
    super();
    this.port.onmessage = ({ data: { worker } }) => {
      this.#worker = worker;
      worker.onmessage = ({ data }) => {
        if ("target_ms" in data) this.#playout.target_ms = data.target_ms;
        else this.#playout.push(data);
      };
    };
  }

  process(_inputs, [[out]]) {
    const { captured } = this.#playout;
    this.#playout.pull(out);
    if (currentTime - this.#reported >= REPORT_S) {
      this.#reported = currentTime;
      const { buffered_ms, counts } = this.#playout;
      this.#worker?.postMessage({ captured, buffered_ms, counts, level_db: this.#playout.takeLevel() });
    }
    return true;
  }
}

registerProcessor("hearing", Hearing);
