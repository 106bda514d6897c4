/** The list of all vehicles of this station. */

import { startTheme } from "./theme.js";
import { startVehicles } from "./vehicles.js";
import { byId, setAttribute, setText } from "./format.js";
import { OtherAlarms } from "./other_alarms.js";
import { isBlocked, isMuted, play, setMuted, unlock } from "./tones.js";
import { alarmsOf, stateOf } from "./vehicle_words.js";

const LOST = "✕ NO CONNECTION TO THE STATION: this list is old; reconnecting";
const ENDED = "○ The station has ended: this list is old. This page connects once it runs again";

const alarms = new OtherAlarms();

/** A press that allows sound does not mute it as well. */
function toggleSound() {
  if (isMuted() || !isBlocked()) setMuted(!isMuted());
  unlock(refreshSound);
  refreshSound();
}

function refreshSound() {
  setText(byId("sound"), isMuted() ? "Unmute" : isBlocked() ? "Allow sound" : "Mute");
  byId("sound").title = "Tones for alarms of vehicles that you drive or watch";
}

/** @param {import("./vehicle_words.js").Row[]|null} rows  @param {boolean} [ended] */
function onRows(rows, ended = false) {
  const tone = rows && alarms.update(rows, null, performance.now()).tone;
  if (tone) play(tone);
  byId("banner").hidden = rows !== null;
  setAttribute(byId("banner"), "data-level", ended ? "ended" : null);
  setText(byId("banner"), rows ? "" : ended ? ENDED : LOST);
  const online = (rows ?? []).filter(({ summary }) => summary?.online).length;
  const alarming = (rows ?? []).filter((row) => alarmsOf(row).length || stateOf(row).level === "late");
  const gone = ended ? "○ station has ended" : "✕ station unreachable";
  const text = !rows ? gone : rows.length ? `${online} of ${rows.length} online` : "none known yet";
  setText(byId("connection"), text);
  setAttribute(byId("connection"), "data-state", rows ? "fine" : ended ? "ended" : "bad");
  const alarm = alarming.length && `▲ ${alarming.map(({ name }) => name).join(", ")}`;
  document.title = [alarm, "Vehicles", "tod-runner"].filter(Boolean).join(" · ");
}

startTheme();
byId("sound").addEventListener("click", toggleSound);
addEventListener("storage", refreshSound); // muted in another window
refreshSound();
startVehicles(byId("fleet"), { current: null, mayLeave: () => true, onRows });
