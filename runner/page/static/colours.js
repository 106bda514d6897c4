/** One colour per camera, the same in every tile and chart; chosen so that colour-blind users can tell them apart as well. */

export const PALETTES = {
  night: ["#56b4e9", "#ecac00", "#53f3c5", "#fff269", "#b46b99", "#ff7847", "#828af9", "#c4def9"],
  day: ["#0b6fae", "#6c2c00", "#10372c", "#8d744d", "#45154f", "#c24100", "#6106af", "#676d7f"],
};

export const isDay = () => document.documentElement.dataset.theme === "day";

export function colourOf(index) {
  const palette = PALETTES[isDay() ? "day" : "night"];
  return palette[index % palette.length];
}

/** A colour of the style sheet, for charts. */
export const themed = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
