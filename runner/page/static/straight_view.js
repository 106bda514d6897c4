/** A camera's pictures, straightened for the video worker. */

import { straightMesh } from "./straight.js";
import { RemoteWarp } from "./remote_warp.js";
import { FILLS } from "./warp.js";

export class StraightView {
  /** @param {any} camera as in hello */
  constructor(camera) {
    const { columns, places, points, shares, triangles } = straightMesh(camera);
    this.mesh = { columns, points };
    const { width, height } = camera;
    this.warp = new RemoteWarp(null);
    this.layer = this.warp.layer(places.map(({ x, y }) => ({ x, y: -y })), points);
    this.layer.share(shares, triangles);
    this.frame = { x: width / 2, y: -height / 2, width, height };
  }

  dispose() {
    this.layer.dispose();
    this.warp.dispose();
  }

  /**
   * The straightened image; parts that the picture does not show are black.
   * @param {import("./picture.js").Picture} picture
   * @param {import("./framing.js").Rectangle} region of the full image that it shows
   * @param {import("./framing.js").Size} size on the screen, px
   * @throws {Error} with a message for the operator
   */
  straightened(picture, region, size) {
    return this.warp.draw(this.warp.sizeFor(size), this.frame, [{ layer: this.layer, fill: FILLS.picture, picture, region }]);
  }
}
