/** Alarms of vehicles in a list that this station drives or watches: which are new, and the tone that is due. Pure. */

import { Alarm } from "./alarm.js";
import { alarmsOf, stateOf } from "./vehicle_words.js";

/** @typedef {import("./vehicle_words.js").Row} Row */

export class OtherAlarms {
  #alarm = new Alarm();
  /** @type {Map<string, string[]>} by vehicle that concerns this station, what was wrong at the last look */
  #known = new Map();

  /**
   * To be called with each list.
   * @param {Row[]} rows
   * @param {string|null} current vehicle whose page this is, which tells its alarms itself
   * @param {number} now ms
   * @returns {{tone: "lost"|"late"|null, news: {name: string, text: string}[]}}
   */
  update(rows, current, now) {
    const news = [];
    /** @type {"lost"|"late"|null} */
    let tone = this.#alarm.overdue(now);
    for (const row of rows) {
      const { name } = row;
      const isOurs = row.summary?.online ? concerns(row) : this.#known.has(name);
      const texts = isOurs && name !== current ? textsOf(row) : [];
      const before = this.#known.get(name) ?? [];
      const added = texts.filter((text) => !before.includes(text));
      if (added.length || (before.length && !texts.length)) tone = this.#alarm.due(name, texts.length ? "lost" : "live", now) ?? tone;
      news.push(...added.map((text) => ({ name, text })));
      if (isOurs) this.#known.set(name, texts);
      else this.#known.delete(name);
    }
    return { tone, news };
  }
}

/** Whether this station drives or watches a vehicle that is online. @param {Row} row */
const concerns = ({ summary }) => Boolean(summary && (summary.is_own || summary.received.length));

/** @param {Row} row */
function textsOf(row) {
  const state = stateOf(row);
  const lost = row.summary?.control === "lost" ? [`${row.summary.holder} was in control and is lost`] : [];
  return [...(state.level === "fine" ? [] : [state.text.replace(/^[✕○] /u, "")]), ...lost, ...alarmsOf(row)];
}
