/** Colours: eight cameras are told apart by colour-blind users, and all text has the contrast that WCAG 2.1, level AA, requires. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

import { PALETTES } from "../../runner/page/static/colours.js";

const APART = 20; // CIE 1976 colour difference; 2.3 is just noticeable
const TEXT = 4.5; // WCAG 2.1, 1.4.3
const GRAPHIC = 3; // 1.4.11
// Of linear RGB, by dichromacy: Machado, Oliveira and Fernandes, IEEE TVCG 15 (2009), severity 1.
const SEEN = {
  all: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
  "all but red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
  "all but green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
  "all but blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
};
const SRGB = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]; // to CIE XYZ
const WHITE = [0.9505, 1, 1.089]; // D65

const times = (matrix, vector) => matrix.map((row) => row.reduce((sum, each, i) => sum + each * vector[i], 0));
const channel = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
const linear = (colour) => [1, 3, 5].map((at) => channel(parseInt(colour.slice(at, at + 2), 16) / 255));

function lab(rgb) {
  const [x, y, z] = times(SRGB, rgb).map((each, i) => each / WHITE[i]).map((t) => (t > 0.008856 ? Math.cbrt(t) : 7.787 * t + 16 / 116));
  return [116 * y - 16, 500 * (x - y), 200 * (y - z)];
}

const luminance = (colour) => times(SRGB, linear(colour))[1];
function contrast(a, b) {
  const [low, high] = [luminance(a), luminance(b)].sort((x, y) => x - y);
  return (high + 0.05) / (low + 0.05);
}

for (const [theme, palette] of Object.entries(PALETTES))
  for (const [who, matrix] of Object.entries(SEEN))
    test(`${theme}: no two cameras look alike to eyes with ${who} cones`, () => {
      const seen = palette.map((colour) => lab(times(matrix, linear(colour)).map((each) => Math.min(1, Math.max(0, each)))));
      const near = seen.flatMap((a, i) => seen.slice(0, i).flatMap((b, j) => (Math.hypot(...a.map((each, k) => each - b[k])) < APART ? [[j, i]] : [])));
      assert.deepEqual(near, []);
    });

const sheet = readFileSync(new URL("../../runner/page/static/style.css", import.meta.url), "utf8");

/** Variables of the style sheet by theme. */
function variables() {
  const block = (selector) => sheet.slice(sheet.indexOf(`${selector} {`)).split("}")[0];
  const read = (text) => Object.fromEntries([...text.matchAll(/--([\w-]+):\s*(#[0-9a-f]{6})/g)].map(([, name, colour]) => [name, colour]));
  return { night: read(block(":root")), day: read(block(':root[data-theme="day"]')) };
}

for (const [theme, colours] of Object.entries(variables())) {
  const { back, panel, raised } = colours;
  for (const name of ["text", "muted", "fine", "warn", "bad", "accent"])
    test(`${theme}: --${name} is readable on every background`, () => {
      for (const behind of [back, panel, raised]) assert.ok(contrast(colours[name], behind) >= TEXT, `on ${behind}: ${contrast(colours[name], behind).toFixed(2)}`);
    });
  test(`${theme}: text on coloured labels is readable`, () => {
    assert.ok(contrast(colours["on-accent"], colours["accent-back"]) >= TEXT);
    assert.ok(contrast("#ffffff", colours["bad-back"]) >= TEXT);
  });
  test(`${theme}: chart lines, swatches and the focus ring stand out`, () => {
    for (const colour of [...PALETTES[theme], colours.predicted, colours.allocated, colours.actual, colours.focus])
      for (const behind of [back, panel]) assert.ok(contrast(colour, behind) >= GRAPHIC, `${colour} on ${behind}: ${contrast(colour, behind).toFixed(2)}`);
  });
}

test("alarm text is readable", () => {
  for (const [fore, behind] of [["#ffffff", "#e01b24"], ["#000000", "#ffb000"], ["#e6ebf0", "#2b333c"]]) assert.ok(contrast(fore, behind) >= TEXT, `${fore} on ${behind}: ${contrast(fore, behind).toFixed(2)}`);
});

test("what is wrong with the bird's-eye view is readable over a white picture", () => {
  const [, colour] = sheet.match(/#birdseye-state \{ color: (#[0-9a-f]{6})/) ?? [];
  const behind = "#404040"; // black of 75 %, as behind all names of pictures
  assert.ok(contrast(colour, behind) >= TEXT, contrast(colour, behind).toFixed(2));
});
