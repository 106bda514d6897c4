/** The list of all vehicles of this station. */

import { startTheme } from "./theme.js";
import { startVehicles } from "./vehicles.js";
import { byId, setAttribute, setText } from "./format.js";
import { alarmsOf, stateOf } from "./vehicle_words.js";

const LOST = "✕ NO CONNECTION TO THE STATION: this list is old; reconnecting";

/** @param {import("./vehicle_words.js").Row[]|null} rows */
function onRows(rows) {
  byId("banner").hidden = rows !== null;
  setText(byId("banner"), rows ? "" : LOST);
  const online = (rows ?? []).filter(({ summary }) => summary?.online).length;
  const alarming = (rows ?? []).filter((row) => alarmsOf(row).length || stateOf(row).level === "late");
  const text = !rows ? "✕ station unreachable" : rows.length ? `${online} of ${rows.length} online` : "none known yet";
  setText(byId("connection"), text);
  setAttribute(byId("connection"), "data-state", rows ? "fine" : "bad");
  const alarm = alarming.length && `▲ ${alarming.map(({ name }) => name).join(", ")}`;
  document.title = [alarm, "Vehicles", "tod-runner"].filter(Boolean).join(" · ");
}

startTheme();
startVehicles(byId("fleet"), { current: null, mayLeave: () => true, onRows });
