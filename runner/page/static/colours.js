/**
 * One colour per camera, the same in every tile and chart, and of about the same hue day and night. Also users who lack one
 * kind of cones tell them apart, and none resembles an alarm; tests/js/colours.test.js states by how much.
 */

export const PALETTES = {
  night: ["#8d6bfb", "#f3f123", "#ff078c", "#74901e", "#d2d3fd", "#e6ad83", "#139695", "#94fede"],
  day: ["#1034c9", "#7f8502", "#ff0b7a", "#18530b", "#bf46fe", "#7d5f56", "#2c918b", "#880f5c"],
};

export const isDay = () => document.documentElement.dataset.theme === "day";

export function colourOf(index) {
  const palette = PALETTES[isDay() ? "day" : "night"];
  return palette[index % palette.length];
}

/** A colour of the style sheet, for charts. */
export const themed = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
