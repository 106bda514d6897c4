/** A camera's picture, straightened by the worker. */

import { straightMesh } from "./straight.js";
import { FILLS, Warp } from "./warp.js";

/** @type {Warp|null} of all straightened pictures: Chromium drops the oldest of more than four contexts in a worker */
let shared = null;

export class StraightView {
  /**
   * @param {any} camera as in hello
   * @throws {Error} with a message for the operator
   */
  constructor(camera) {
    const { places, points, shares, triangles } = straightMesh(camera);
    const { width, height } = camera;
    if (!shared || shared.lost) shared = new Warp(new OffscreenCanvas(1, 1));
    this.warp = shared;
    this.layer = this.warp.layer(places.map(({ x, y }) => ({ x, y: -y })), points);
    this.layer.share(shares, triangles);
    this.frame = { x: width / 2, y: -height / 2, width, height };
  }

  dispose() {
    this.layer.dispose();
  }

  /**
   * Fill a canvas with the straightened image; parts that the picture does not show are black.
   * @param {import("./picture.js").Picture} picture
   * @param {import("./framing.js").Rectangle} region of the full image that it shows
   * @throws {Error} with a message for the operator
   */
  paint(context, picture, region) {
    const { width, height } = context.canvas;
    if (this.warp.lost) throw new Error("the browser dropped the WebGL context");
    this.warp.draw({ width, height }, this.frame, [{ layer: this.layer, fill: FILLS.picture, picture, region }]);
    context.drawImage(this.warp.canvas, 0, 0);
  }
}
