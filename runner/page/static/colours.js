/** One colour per camera, the same in every tile and chart; also for colour-blind users (after Okabe and Ito). */

const NIGHT = ["#56b4e9", "#e69f00", "#2fc59a", "#f0e442", "#d98cc0", "#ff7847", "#9aa5ff", "#c9ced4"];
const DAY = ["#0b6fae", "#a86a00", "#00785a", "#7a6f00", "#a3478a", "#c24100", "#4a4fc4", "#4b5560"];

export const isDay = () => document.documentElement.dataset.theme === "day";

export const colourOf = (index) => (isDay() ? DAY : NIGHT)[index % NIGHT.length];

/** A colour of the style sheet, for charts. */
export const themed = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
