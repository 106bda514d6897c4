/** Colours: eight cameras are told apart by colour-blind users, and all text has the contrast that WCAG 2.1, level AA, requires. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

import { PALETTES } from "../../runner/page/static/colours.js";
import { AMBER, RED } from "../../runner/page/static/overlay.js";

// Least CIEDE2000 differences: about 1 is just noticeable side by side; small swatches far apart need many times that.
const APART = { all: 24, "all but red": 15, "all but green": 15, "all but blue": 15 };
const UNLIKE_ALARMS = 15;
const LIGHTNESS = { night: [50, 95], day: [30, 60] }; // L*: darker by day, all look black in a small swatch
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

/** Sharma, Wu and Dalal: The CIEDE2000 color-difference formula, Color Research and Application 30 (2005). */
function difference([L1, a1, b1], [L2, a2, b2]) {
  const { cos, sin, sqrt, hypot, exp, abs, atan2, PI } = Math;
  const radians = PI / 180;
  const share = (chroma) => sqrt(chroma ** 7 / (chroma ** 7 + 25 ** 7));
  const stretch = 1.5 - 0.5 * share((hypot(a1, b1) + hypot(a2, b2)) / 2);
  const [C1, C2] = [hypot(stretch * a1, b1), hypot(stretch * a2, b2)];
  const [h1, h2] = [[a1, b1], [a2, b2]].map(([a, b]) => (atan2(b, stretch * a) / radians + 360) % 360);
  const isGrey = C1 * C2 === 0;
  const turn = isGrey ? 0 : ((h2 - h1 + 540) % 360) - 180;
  const [L, C, h] = [(L1 + L2) / 2, (C1 + C2) / 2, isGrey ? h1 + h2 : h1 + turn / 2];
  const wave = (amplitude, waves, shift) => amplitude * cos((waves * h + shift) * radians);
  const T = 1 + wave(-0.17, 1, -30) + wave(0.24, 2, 0) + wave(0.32, 3, 6) + wave(-0.2, 4, -63);
  const away = abs((((h - 275) % 360) + 540) % 360 - 180);
  const rotation = -2 * share(C) * sin(60 * exp(-((away / 25) ** 2)) * radians);
  const dL = (L2 - L1) / (1 + (0.015 * (L - 50) ** 2) / sqrt(20 + (L - 50) ** 2));
  const dC = (C2 - C1) / (1 + 0.045 * C);
  const dH = (2 * sqrt(C1 * C2) * sin((turn / 2) * radians)) / (1 + 0.015 * C * T);
  return sqrt(dL ** 2 + dC ** 2 + dH ** 2 + rotation * dC * dH);
}

test("the difference of colours is that of the formula's published examples", () => {
  const examples = [
    [[50, 2.6772, -79.7751], [50, 0, -82.7485], 2.0425],
    [[50, -1, 2], [50, 0, 0], 2.3669],
    [[50, 2.49, -0.001], [50, -2.49, 0.0011], 7.2195],
    [[50, 2.5, 0], [73, 25, -18], 27.1492],
    [[60.2574, -34.0099, 36.2677], [60.4626, -34.1751, 39.4387], 1.2644],
    [[22.7233, 20.0904, -46.694], [23.0331, 14.973, -42.5619], 2.0373],
    [[2.0776, 0.0795, -1.135], [0.9033, -0.0636, -0.5514], 0.9082],
  ];
  for (const [a, b, expected] of examples) assert.equal(difference(a, b).toFixed(4), expected.toFixed(4));
});

const luminance = (colour) => times(SRGB, linear(colour))[1];
function contrast(a, b) {
  const [low, high] = [luminance(a), luminance(b)].sort((x, y) => x - y);
  return (high + 0.05) / (low + 0.05);
}

const seenBy = (matrix, colour) => lab(times(matrix, linear(colour)).map((each) => Math.min(1, Math.max(0, each))));

for (const [theme, palette] of Object.entries(PALETTES)) {
  for (const [who, matrix] of Object.entries(SEEN))
    test(`${theme}: no two cameras look alike to eyes with ${who} cones`, () => {
      const seen = palette.map((colour) => seenBy(matrix, colour));
      const pairs = seen.flatMap((a, i) => seen.slice(0, i).map((b, j) => ({ pair: [palette[j], palette[i]], by: difference(a, b) })));
      assert.equal(pairs.length, 28); // of eight cameras
      assert.deepEqual(pairs.filter(({ by }) => by < APART[who]), []);
    });
  test(`${theme}: no camera is as dark or light as its background or looks like an alarm`, () => {
    const [darkest, lightest] = LIGHTNESS[theme];
    for (const colour of palette) {
      const own = seenBy(SEEN.all, colour);
      assert.ok(own[0] >= darkest && own[0] <= lightest, `${colour}: L* ${own[0].toFixed(1)}`);
      for (const alarm of [RED, AMBER]) assert.ok(difference(own, seenBy(SEEN.all, alarm)) >= UNLIKE_ALARMS, `${colour}: ${alarm}`);
    }
  });
}

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
