/** Pixels of pictures. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { scaled } from "../../runner/page/static/yuv.js";

const image = (width, height, pixels = new Array(width * height).fill(0)) => ({ width, height, data: new Uint8ClampedArray(new Uint32Array(pixels).buffer) });
const pixelsOf = ({ data }) => [...new Uint32Array(data.buffer)];

test("an image is stretched to another size, larger or smaller", () => {
  const small = image(2, 2, [1, 2, 3, 4]);
  assert.deepEqual(pixelsOf(scaled(small, image(4, 2))), [1, 1, 2, 2, 3, 3, 4, 4]);
  assert.deepEqual(pixelsOf(scaled(small, image(2, 4))), [1, 2, 1, 2, 3, 4, 3, 4]);
  assert.deepEqual(pixelsOf(scaled(image(4, 1, [1, 2, 3, 4]), image(2, 1))), [2, 4]);
  assert.deepEqual(pixelsOf(scaled(small, image(2, 2))), [1, 2, 3, 4]);
});
