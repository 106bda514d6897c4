/** The other vehicles of this station, beside the pictures of this one; there are none on a station for one vehicle. */

import { inControl, publish, store } from "./store.js";
import { showProblem } from "./requests.js";
import { byId } from "./format.js";
import { startVehicles } from "./vehicles.js";
import { OtherAlarms } from "./other_alarms.js";

const STANDING_MPS = 0.3;
const AGAIN_MS = 3000; // within which a second press counts

let asked = ""; // the vehicle that was to be opened while this one moves
let askedAt = -Infinity;

/** A moving vehicle is left with a second press only. @param {string} name of another one */
function mayLeave(name) {
  const speed = store.sample?.position?.speed_mps;
  const isMoving = inControl() && store.state?.online && (speed === undefined || speed >= STANDING_MPS);
  if (!isMoving || (name === asked && performance.now() - askedAt < AGAIN_MS)) return true;
  [asked, askedAt] = [name, performance.now()];
  showProblem(`you are in control, and it ${speed === undefined ? "may be moving" : "is moving"}: press again to leave it for ${name}`);
  return false;
}

/** @param {ReturnType<OtherAlarms["update"]>} alarms */
function tell({ tone, news }) {
  for (const { name, text } of news) publish("toast", { text, level: "problem", of: name });
  publish("other", tone);
}

export function startOthers() {
  const current = location.pathname.match(/^\/vehicle\/([^/]+)\/$/)?.[1];
  if (!current) return;
  const element = byId("others");
  element.hidden = false;
  const list = document.createElement("a");
  Object.assign(list, { href: "/", textContent: "All vehicles", className: "all" });
  list.addEventListener("click", (event) => mayLeave("the list") || event.preventDefault());
  element.append(list);
  const alarms = new OtherAlarms();
  startVehicles(element, { current, mayLeave, onRows: (rows) => rows && tell(alarms.update(rows, current, performance.now())) });
}
