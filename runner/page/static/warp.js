/**
 * Draws pictures through meshes with WebGL: each vertex holds the point of a camera's full image that is shown there, and the
 * picture's share. Shares of several pictures are added.
 */

const VERTEX = `#version 300 es
layout(location = 0) in vec2 place;
layout(location = 1) in vec2 point;
layout(location = 2) in float share;
uniform vec4 frame;  // of the places on the canvas: its middle, and half its extents; y up
uniform vec4 region; // of the full image that the picture shows: left, top, width, height
out vec2 at;
out float part;
void main() {
  at = (point - region.xy) / region.zw;
  part = share;
  gl_Position = vec4((place - frame.xy) / frame.zw, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 at;
in float part;
uniform sampler2D picture;
uniform int fill; // as in FILLS
uniform float stripe; // px
out vec4 colour;
void main() {
  vec3 seen = texture(picture, at).rgb;
  float across = mod(gl_FragCoord.x + gl_FragCoord.y, stripe) / stripe;
  if (fill == 1) seen = across < 0.35 ? vec3(0.75, 0.1, 0.14) : vec3(0.13, 0.0, 0.0);
  if (fill == 2) seen = vec3(0.17, 0.2, 0.24);
  if (at.x < 0.0 || at.y < 0.0 || at.x > 1.0 || at.y > 1.0) discard;
  colour = vec4(seen * part, part);
}`;

/** What is drawn through a mesh: the picture, red stripes in place of a stalled one, or grey if there is none. */
export const FILLS = { picture: 0, alarm: 1, none: 2 };
const FLOATS = 5; // of a vertex
const BYTES = 4;
const ANISOTROPY = 8;
const STRIPE_PX = 14;

/** @typedef {import("./projection.js").Point} Point */
/** @typedef {import("./framing.js").Rectangle} Rectangle */
/** @typedef {import("./picture.js").Picture} Picture */
/**
 * @typedef {{x: number, y: number, width: number, height: number}} Frame
 * middle and size of what the canvas shows, in units of the places; y up
 */

/** One picture and its mesh. */
export class Layer {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {Point[]} places on the canvas, y up  @param {(Point|null)[]} points px of the full image
   */
  constructor(gl, places, points) {
    this.gl = gl;
    this.count = 0; // of the triangles' corners
    this.data = new Float32Array(FLOATS * places.length);
    for (const [i, { x, y }] of places.entries()) this.data.set([x, y, points[i]?.x ?? 0, points[i]?.y ?? 0], FLOATS * i);
    this.vertices = gl.createVertexArray();
    this.buffer = gl.createBuffer();
    this.corners = gl.createBuffer();
    this.texture = gl.createTexture();
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    for (const [location, size, begin] of [[0, 2, 0], [1, 2, 2], [2, 1, 4]]) {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, size, gl.FLOAT, false, FLOATS * BYTES, begin * BYTES);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.bindVertexArray(null);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    const anisotropy = gl.getExtension("EXT_texture_filter_anisotropic"); // without it distant ground is blurred along the line of sight
    const most = anisotropy && gl.getParameter(anisotropy.MAX_TEXTURE_MAX_ANISOTROPY_EXT);
    if (anisotropy) gl.texParameterf(gl.TEXTURE_2D, anisotropy.TEXTURE_MAX_ANISOTROPY_EXT, Math.min(ANISOTROPY, most));
  }

  /** @param {Float32Array} shares of the picture at each vertex  @param {Uint32Array} triangles that are drawn, as vertices */
  share(shares, triangles) {
    const { gl, data } = this;
    for (const [i, share] of shares.entries()) data[FLOATS * i + FLOATS - 1] = share;
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.count = triangles.length;
  }

  dispose() {
    const { gl } = this;
    gl.deleteVertexArray(this.vertices);
    gl.deleteBuffer(this.buffer);
    gl.deleteBuffer(this.corners);
    gl.deleteTexture(this.texture);
  }

  /** Bind the texture, after uploading a picture if there is a new one. @param {Picture|null} picture */
  load(picture) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    if (!picture) return;
    picture.upload(gl);
    gl.generateMipmap(gl.TEXTURE_2D);
  }
}

export class Warp {
  /**
   * @param {OffscreenCanvas} canvas
   * @throws {Error} with a message for the operator: there is no WebGL 2
   */
  constructor(canvas) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.gl = gl;
    this.lost = false; // browsers drop the context when the graphics driver restarts
    canvas.addEventListener("webglcontextlost", () => (this.lost = true));
    const program = (this.program = linkedProgram(gl, VERTEX, FRAGMENT));
    gl.useProgram(program);
    this.uniforms = Object.fromEntries(["frame", "region", "fill", "stripe"].map((name) => [name, gl.getUniformLocation(program, name)]));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    gl.clearColor(0, 0, 0, 1);
  }

  /** @param {Point[]} places  @param {(Point|null)[]} points */
  layer(places, points) {
    return new Layer(this.gl, places, points);
  }

  /**
   * @param {{width: number, height: number}} size of the canvas, px
   * @param {Frame} frame
   * @param {{layer: Layer, fill: number, picture: Picture|null, region: Rectangle}[]} drawn
   *   picture: null if the layer has it already, or needs none
   */
  draw({ width, height }, frame, drawn) {
    const { gl, canvas, uniforms } = this;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniform4f(uniforms.frame, frame.x, frame.y, frame.width / 2, frame.height / 2);
    gl.uniform1f(uniforms.stripe, STRIPE_PX);
    for (const { layer, fill, picture, region } of drawn) {
      layer.load(picture);
      gl.uniform1i(uniforms.fill, fill);
      gl.uniform4f(uniforms.region, region.x, region.y, region.width, region.height);
      gl.bindVertexArray(layer.vertices);
      gl.drawElements(gl.TRIANGLES, layer.count, gl.UNSIGNED_INT, 0);
    }
    gl.bindVertexArray(null);
  }

  /** Wait until it is drawn, so that no more is ordered than can be drawn. Chromium's `finish` does not wait. */
  wait() {
    const { gl } = this;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  /** What was drawn; its first row is the lowest. */
  pixels() {
    const { gl, canvas: { width, height } } = this;
    const image = new ImageData(width, height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(image.data.buffer));
    return image;
  }
}

/** @param {WebGL2RenderingContext} gl  @param {string} vertex  @param {string} fragment */
export function linkedProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of /** @type {[number, string][]} */ ([[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]])) {
    const shader = gl.createShader(kind);
    if (!shader) throw new Error("WebGL lost its context");
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`WebGL: ${gl.getProgramInfoLog(program)}`);
  return program;
}
