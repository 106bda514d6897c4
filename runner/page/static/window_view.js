/** States to the station, from the worker, what this window shows of each camera. */

import { NOWHERE, seenFromAbove, seenInBox, seenStraight, Stating, united } from "./seen.js";

/** @typedef {import("./stream.js").Stream} Stream */
/** @typedef {import("./seen.js").Seen} Seen */

const STATED = 100;

export class WindowView {
  stated = []; // for benchmarks: page time and view of each change
  stating = new Stating();
  /** @type {{key: string, seen: Seen[]}} */
  above = { key: "", seen: [] }; // by the bird's-eye view, which takes longer to compute

  /** @param {import("./ground_view.js").GroundView} ground  @param {(message: object) => boolean} send */
  constructor(ground, send) {
    this.ground = ground;
    this.send = send;
  }

  /** The connection is new: nothing has been stated on it. */
  reset() {
    this.stating = new Stating();
  }

  /** State it if it is time to; to be called often. @param {Stream[]} streams  @param {number} now ms */
  state(streams, now) {
    if (!this.stating.isDue(now) || !streams.some(({ canvas }) => canvas.isShown)) return; // not laid out yet
    const view = this.view(streams);
    const [text, before] = [JSON.stringify(view), this.stating.text];
    if (!this.stating.states(text, now)) return;
    if (!this.send({ view })) return this.reset();
    if (text === before) return;
    this.stated.push([now, view]);
    if (this.stated.length > STATED) this.stated.shift();
  }

  /** By camera; one that is left out is seen in full. @param {Stream[]} streams  @returns {Record<string, Seen>} */
  view(streams) {
    const view = Object.fromEntries(streams.map((stream) => [stream.name, seenInTile(stream)]));
    if (!this.ground.isDrawing()) return view;
    for (const [i, seen] of this.seenFromAbove().entries()) {
      const { name } = this.ground.streams[i];
      view[name] = united(view[name], seen);
    }
    for (const { name } of this.ground.lattice ? [] : this.ground.streams) delete view[name]; // nothing is known yet
    return view;
  }

  /** By the bird's-eye view, of its cameras. */
  seenFromAbove() {
    const { lattice, sights, display, dimensions, streams } = this.ground;
    if (!lattice || !dimensions) return [];
    const frames = streams.map(({ region }) => region.frame);
    const key = JSON.stringify([streams.map(({ camera }) => camera), dimensions, display, frames]);
    if (key !== this.above.key) this.above = { key, seen: seenFromAbove(sights, lattice, frames, display, dimensions) };
    return this.above.seen;
  }
}

/** @param {Stream} stream */
function seenInTile({ camera, canvas: { display }, region: { frame }, straight }) {
  if (display.covered) return NOWHERE;
  return straight ? seenStraight(frame, display, straight.mesh, camera) : seenInBox(frame, display);
}
