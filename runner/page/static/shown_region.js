/**
 * Which part of the full image a camera's pictures show: what each says itself; otherwise the region of interest, once it has
 * been read back.
 */

import { now } from "./clock.js";

const UNTIMED_MS = 1000; // longest transit of a picture without a capture time

/** @typedef {{picture: import("./picture.js").Picture, meta: any}} Shown */

export class ShownRegion {
  /** @type {import("./framing.js").Rectangle|null} */
  region = null; // that pictures show; null: unknown, or about to change
  /** @type {import("./framing.js").Size|null} */
  expected = null; // size of these pictures; null: likewise
  region_since = Infinity; // page time: pictures captured from this time on show the region
  size_since = Infinity;
  placed = false; // whether each picture that shows a part only says which
  /** @type {import("./framing.js").Rectangle|null} */
  crop = null; // the part of the full image that is shown of whole pictures, chosen on this page alone; null: all of it

  /** @param {any} station see `Stream`  @param {import("./framing.js").Rectangle} full the image */
  constructor(station, full) {
    this.station = station;
    this.full = full;
    this.frame = full; // what is laid out on the screen, of which the pictures may show a part
  }

  /** The vehicle's decision. */
  update({ roi, chosen = roi, placed = false, width, height, applied }) {
    Object.assign(this, { frame: this.crop ?? chosen, placed });
    const { x, y, width: wide, height: high } = applied.roi ?? roi;
    const size = applied.size ?? { width, height };
    const isApplied = x === roi.x && y === roi.y && wide === roi.width && high === roi.height;
    const region = isApplied ? { x, y, width: wide, height: high } : null;
    const expected = isApplied && size.width === width && size.height === height ? size : null;
    const since = now(); // the station's clock may be unknown yet, or be set
    if (JSON.stringify(region) !== JSON.stringify(this.region)) Object.assign(this, { region, region_since: since });
    if (JSON.stringify(expected) !== JSON.stringify(this.expected)) Object.assign(this, { expected, size_since: since });
  }

  /** @param {import("./framing.js").Rectangle|null} crop */
  setCrop(crop) {
    Object.assign(this, { crop, frame: crop ?? this.full });
  }

  /** The region that a picture shows by its own words; null: it does not say. @param {Shown|null} one */
  stated(one) {
    return one && this.statedIn(one.meta);
  }

  /** As above. @param {any} meta of the picture */
  statedIn(meta) {
    return meta.region ?? (this.placed || this.crop ? this.full : null);
  }

  /**
   * Where a picture that says what it shows is in the frame; null: it shows the whole frame, with square pixels, or does not say.
   * @param {Shown|null} one
   */
  placeOf(one) {
    const [region, { frame }] = [this.stated(one), this];
    const fills = one && region && sameRegion(region, frame) && hasAspectOf(one.picture, region);
    return region && !fills ? { region, frame } : null;
  }

  /** The region that a picture is known to show. @param {Shown|null} one */
  of(one) {
    const stated = this.stated(one);
    if (stated) return stated;
    const { region } = this;
    const isKnown = one && region && this.capturedAt(one.meta) >= this.region_since && hasAspectOf(one.picture, region);
    return isKnown ? region : null;
  }

  /** The same, if the picture has the size that was decided. @param {Shown|null} one */
  ofSized(one) {
    const { expected } = this;
    const { width, height } = one?.picture ?? {};
    const fits = one && expected && width === expected.width && height === expected.height;
    return fits && this.capturedAt(one.meta) >= this.size_since ? this.of(one) : null;
  }

  /** Page time at which a picture was captured; if unknown, the earliest possible time. */
  capturedAt({ captured = NaN, arrived = NaN }) {
    return (Number.isFinite(captured) ? captured : arrived - UNTIMED_MS) - this.station.clock.offset;
  }
}

export const sameRegion = (a, b) => a.x === b.x && a.y === b.y && a.width === b.width && a.height === b.height;

/** Whether a picture has a region's aspect ratio, to within rounding to even numbers of px. */
function hasAspectOf(picture, { width, height }) {
  return Math.abs(picture.width * height - picture.height * width) <= width + height;
}
