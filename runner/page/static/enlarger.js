/**
 * Enlarges pictures with a cubic kernel (Catmull-Rom), by WebGL: Chromium's canvas enlarges the frames of a video linearly
 * whatever it is told. Only for a GPU; software would draw 16 px for each one.
 */

import { linkedProgram } from "./warp.js";

const VERTEX = `#version 300 es
out vec2 at; // of the picture, 0 to 1, from its upper left corner
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  at = vec2(corner.x, 1.0 - corner.y);
  gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 at;
uniform sampler2D picture;
out vec4 colour;
vec4 weights(float t) {
  float square = t * t, cube = square * t;
  return 0.5 * vec4(2.0 * square - cube - t, 3.0 * cube - 5.0 * square + 2.0, 4.0 * square - 3.0 * cube + t, cube - square);
}
void main() {
  ivec2 last = textureSize(picture, 0) - 1;
  vec2 place = at * vec2(last + 1) - 0.5;
  vec2 first = floor(place);
  vec4 across = weights(place.x - first.x), down = weights(place.y - first.y);
  vec3 sum = vec3(0.0);
  for (int y = 0; y < 4; y++) for (int x = 0; x < 4; x++) {
    ivec2 texel = clamp(ivec2(first) + ivec2(x - 1, y - 1), ivec2(0), last);
    sum += across[x] * down[y] * texelFetch(picture, texel, 0).rgb;
  }
  colour = vec4(sum, 1.0);
}`;

/** @typedef {{upload(gl: WebGL2RenderingContext): void}} Uploaded */

export class Enlarger {
  isLost = false; // browsers drop the context when the graphics driver restarts

  /** @throws {Error} there is no WebGL 2 */
  constructor() {
    this.canvas = new OffscreenCanvas(1, 1);
    const gl = this.canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.gl = gl;
    this.canvas.addEventListener("webglcontextlost", () => (this.isLost = true));
    gl.useProgram(linkedProgram(gl, VERTEX, FRAGMENT));
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  }

  /**
   * Draw a picture, enlarged, into a place of a canvas.
   * @param {OffscreenCanvasRenderingContext2D} context  @param {Uploaded} picture
   * @param {import("./framing.js").Rectangle} place
   */
  paint(context, picture, { x, y, width, height }) {
    const { gl, canvas } = this;
    const [wide, high] = [Math.round(width), Math.round(height)];
    // It only grows: pictures of several cameras take turns.
    if (canvas.width < wide || canvas.height < high) {
      Object.assign(canvas, { width: Math.max(canvas.width, wide), height: Math.max(canvas.height, high) });
    }
    picture.upload(gl);
    gl.viewport(0, canvas.height - high, wide, high); // counted upwards
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    context.drawImage(canvas, 0, 0, wide, high, x, y, width, height);
  }
}
