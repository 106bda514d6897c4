/** What the vehicle believes of its uplink, and what predictions of it are worth, in words for a driver. */

import { rate } from "./format.js";

const SURE = 0.3; // deviation, ln: a capacity that is less sure is not stated
const STEP = 5; // %: finer figures would change all the time
const SCATTER = 10; // %: errors below this are not worth words
const TRUE = 80; // %: changes come true
const UNTRUE = 15; // %: they do not
const SAID = ["capacity of the link", "the link drops"]; // in reasons of decisions

const rounded = (share, step = STEP) => step * Math.round((100 * share) / step);

/** A rate in two digits: 2400. */
const about = (kbps) => Number(kbps.toPrecision(2));

/**
 * Link: about 2400 kbit/s, 10 % kept free. Predictions here are 20 % too high.
 * @param {import("./records.js").Believed|undefined} believed
 * @returns {string} "" while too little is known
 */
export function believedWords(believed) {
  return believed ? [linkWords(believed), predictionWords(believed)].filter(Boolean).join(" ") : "";
}

/** Why the total is limited, without what these words say. @param {string[]} reasons  @param {string} words */
export const furtherReasons = (reasons, words) =>
  reasons.filter((reason) => !words.startsWith("Link: ") || !SAID.some((each) => reason.includes(each)));

function linkWords({ kbps, deviation, margin, policer_kbps }) {
  if (policer_kbps !== null) return `Link: drops what exceeds ${rate(about(policer_kbps))}.`;
  return deviation > SURE ? "" : `Link: about ${rate(about(kbps))}, ${rounded(1 - Math.exp(-margin))} % kept free.`;
}

function predictionWords({ bias, error, gain }) {
  if (bias === null) return "";
  const off = rounded(Math.exp(-bias) - 1);
  const scatter = rounded(error);
  const give = scatter >= SCATTER ? ` ± ${scatter} %` : "";
  const times = `${Math.round(Math.exp(-bias))} times too high`;
  const level = off >= 100 ? times : off ? `${Math.abs(off)} % too ${off > 0 ? "high" : "low"}` : "right";
  return `Predictions here are ${level}${give}${gain === null ? "" : `, changes ${changeWords(rounded(gain))}`}.`;
}

const changeWords = (share) => (share >= TRUE ? "come true" : share <= UNTRUE ? "do not come true" : `come true to ${share} %`);
