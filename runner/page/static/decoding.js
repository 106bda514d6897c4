/** One camera's decoder in the worker: from the station's units to pictures, and what to do when there are none. */

import { codecOf, isKnown, nameOf, spsOf, USUAL } from "./codec.js";
import { now } from "./clock.js";

export const KEY = 1;
export const CATCH_UP = 2;
export const RESTART = 4;
export const DAMAGED = 8;
export const PLACED = 16; // the unit states its region

const QUEUE = 40; // units waiting in the decoder: beyond this, restarting from a burst is faster
const LAG_MS = 2000; // extra delay: as long as the burst that would replace it
const RESYNC_MIN_MS = 2000; // doubled each time it does not help: a burst costs more than the fault it repairs
const RESYNC_MAX_MS = 16000;
const SETTLE_MS = 2000; // after a restart the decoder may take this long for the burst
const REFUSED_RETRY_MS = 5000; // between two checks whether the browser can decode a refused stream
const NO_VIDEO = "This browser has no WebCodecs.";
// Not every encoder signals the colour space that the vehicle uses (ITU-R BT.709); for small pictures browsers assume BT.601.
/** @type {VideoColorSpaceInit} */
const BT709 = { primaries: "bt709", transfer: "bt709", matrix: "bt709", fullRange: false };

/**
 * @typedef {{flags: number, sequence: number, captured: number, arrived: number, data: Uint8Array, region: Rectangle|null}} Unit
 * region: what it shows of the full image, if it says so itself
 * @typedef {import("./framing.js").Rectangle} Rectangle
 */

/**
 * @typedef {object} Viewer who shows the pictures
 * @property {() => boolean} hasDrawn whether a picture was drawn since the last restart
 * @property {(unit: Unit, received: number) => void} onUnit a unit is about to be decoded
 * @property {(frame: VideoFrame, meta: any) => void} onFrame
 * @property {() => void} onClosed what was decoded no longer counts
 * @property {() => void} onRestart
 */

export class Decoding {
  /** @type {VideoDecoder|null} */
  decoder = null;
  /** @type {string|null} */
  sps = null;
  codec = "";
  meta = new Map(); // by timestamp: metadata of a unit in the decoder
  timestamp = 0;
  counts = { decoded: 0, errors: 0, resyncs: 0 };
  error = ""; // the decoder's last one
  refused_at = now(); // when the browser last reported that it has no decoder
  last_resync = -Infinity;
  restarted = -Infinity;
  resync_interval = RESYNC_MIN_MS;
  /** @type {number|null} */
  transit = null; // usual time from the station to this page

  /** @param {any} camera as in hello  @param {any} station see `Stream`  @param {Viewer} viewer */
  constructor(camera, station, viewer) {
    this.camera = camera;
    this.station = station;
    this.viewer = viewer;
    const unknown = isKnown(camera.codec) ? "" : `This page cannot show ${nameOf(camera.codec)}.`;
    this.lasting = station.video ? unknown : NO_VIDEO; // why there will never be a picture
    this.refused = this.lasting; // why there is none
  }

  /** @param {Unit} unit  @param {number} received */
  receive(unit, received) {
    if (this.refused && !this.lasting && unit.flags & KEY) this.retryRefused(unit.data);
    if (this.refused) return;
    if (unit.flags & RESTART) this.restart();
    if (unit.flags & KEY) this.configure(unit.data);
    if (!this.decoder || this.decoder.state !== "configured") return this.resync();
    if (this.isLagging(unit, received)) this.resync();
    this.decode(unit, received);
  }

  restart() {
    this.close();
    this.viewer.onRestart();
    this.transit = null;
    this.restarted = now();
  }

  /** A key unit sets the decoder up, and again if its parameters change. */
  configure(data) {
    const sps = spsOf(data, this.camera.codec);
    if (!sps && !this.decoder) return this.checkUsual();
    if (!sps || (this.decoder && String(sps) === this.sps)) return;
    this.close();
    this.sps = String(sps);
    const codec = codecOf(sps, this.camera.codec);
    const decoder = new VideoDecoder({
      output: (frame) => (decoder === this.decoder ? this.onFrame(frame) : frame.close()),
      error: (error) => decoder === this.decoder && this.onError(error),
    });
    this.decoder = decoder;
    this.codec = codec;
    decoder.configure({ codec, optimizeForLatency: true, colorSpace: BT709 });
  }

  /** Without parameter sets nothing can be decoded, but whether it ever could is known from the codec. */
  async checkUsual() {
    const why = await this.refusal(USUAL[this.camera.codec]);
    if (why && !this.decoder && this.sps === null) Object.assign(this, { refused: why, refused_at: now() });
  }

  /** Why the browser does not decode this stream, "" if it can. Browsers name the error differently. */
  async refusal(codec) {
    const { supported } = await VideoDecoder.isConfigSupported({ codec }).catch(() => ({ supported: false }));
    const name = nameOf(this.camera.codec);
    return supported ? "" : `This browser has no decoder for ${name} (${codec}). Use an H.264 graph or another browser.`;
  }

  /** A different stream may have a profile that the browser decodes, and a decoder may be missing only temporarily. */
  async retryRefused(data) {
    const sps = spsOf(data, this.camera.codec);
    if (!sps) return;
    if (String(sps) !== this.sps) return void (this.refused = "");
    if (now() - this.refused_at < REFUSED_RETRY_MS) return;
    this.refused_at = now();
    if (!(await this.refusal(this.codec))) this.refused = "";
  }

  decode(unit, received) {
    this.timestamp += 1000;
    this.meta.set(this.timestamp, { ...unit, data: null, timestamp: this.timestamp, received });
    this.viewer.onUnit(unit, received);
    const type = unit.flags & KEY ? "key" : "delta";
    try {
      this.decoder?.decode(new EncodedVideoChunk({ type, timestamp: this.timestamp, data: unit.data }));
    } catch (error) {
      this.onError(error); // a delta unit when the decoder expects a key unit
    }
  }

  isLagging(unit, received) {
    if (unit.flags & CATCH_UP || this.isSettling()) return false;
    if (this.queueLength() > QUEUE) return true;
    const transit = this.station.clock.toStation(received) - unit.arrived;
    if (!Number.isFinite(transit)) return false;
    this.transit = this.transit === null ? transit : Math.min(transit, this.transit + 0.5);
    return transit > this.transit + LAG_MS;
  }

  /** Whether the decoder is still busy with the initial burst. */
  isSettling() {
    return !this.viewer.hasDrawn() && now() - this.restarted < SETTLE_MS;
  }

  /** Units in the decoder. */
  queueLength() {
    return this.decoder?.decodeQueueSize ?? 0;
  }

  onFrame(frame) {
    const meta = this.meta.get(frame.timestamp);
    for (const key of this.meta.keys()) if (key <= frame.timestamp) this.meta.delete(key);
    this.counts.decoded++;
    const hasNewer = this.isSettling() && this.queueLength() > 1;
    if (!meta || meta.flags & CATCH_UP || hasNewer) return frame.close();
    this.viewer.onFrame(frame, { ...meta, decoded: now() });
  }

  async onError(error) {
    this.close();
    const { codec } = this;
    const why = await this.refusal(codec);
    // Another burst would not help.
    if (why && codec === this.codec) return void Object.assign(this, { refused: why, refused_at: now() });
    this.counts.errors++;
    this.error = String(error);
    this.resync();
  }

  resync() {
    const since = now() - this.last_resync;
    if (since < this.resync_interval) return;
    const isRare = since > 2 * this.resync_interval;
    this.resync_interval = isRare ? RESYNC_MIN_MS : Math.min(RESYNC_MAX_MS, 2 * this.resync_interval);
    this.last_resync = now();
    this.counts.resyncs++;
    this.station.resync(this.camera.name);
  }

  close() {
    if (this.decoder && this.decoder.state !== "closed") this.decoder.close();
    this.decoder = null;
    this.viewer.onClosed();
    this.meta.clear();
  }
}
