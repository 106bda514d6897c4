/** The one total that all of the page shows, from what the vehicle publishes. Pure; kbit/s. */

import { whole } from "./format.js";

/**
 * @typedef {object} Totals
 * @property {number} total in force, after all rules, of all copies that leave the vehicle
 * @property {number} wanted by prediction or operator
 * @property {number} copies of each camera, at most
 * @property {number} each what one copy of all cameras has
 *
 * @param {import("./store.js").State|null} state null, or of a vehicle that is offline: unknown
 * @returns {Totals|null}
 */
export function totalsOf(state) {
  if (!state?.online) return null;
  const each = Object.values(state.cameras).reduce((sum, { kbps }) => sum + kbps, 0);
  return { total: state.total_kbps, wanted: state.asked_kbps, copies: Math.max(1, ...Object.values(state.copies ?? {})), each };
}

/** What the total is of: that was wanted and is limited, and how many copies share it. @param {Totals|null} totals */
export const ofWords = (totals) => (totals && totals.total < totals.wanted ? ` of ${whole(totals.wanted)}` : "");

/** @param {Totals|null} totals */
export const copiesWords = (totals) => (totals && totals.copies > 1 ? ` for ${totals.copies} copies, ${whole(totals.each)} each` : "");

/**
 * The value of the slider: in mode C what the operator has set, which rules may lower; otherwise the total in force, which
 * may exceed a prediction.
 * @param {Totals|null} totals  @param {string|null} mode
 */
export const sliderValue = (totals, mode) => (mode === "collective" ? totals?.wanted : totals?.total);
