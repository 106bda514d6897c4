/**
 * The statuses and ages of the pictures in monitors: each monitor reports its own to the pages in the same browser, of which the one in
 * control alerts its driver.
 */

import { listen, publish, remind, store } from "./store.js";
import { checkRegularly } from "./periodic.js";
import { reportProblem } from "./requests.js";
import { displayName } from "./format.js";

const REPORT_MS = 500; // at most; usually its worker makes a monitor report more often, also while it is hidden
const SILENT_MS = 3000; // a monitor that has not reported for this long has crashed
const NO_AGE = { age_ms: null, bound_ms: NaN };
const channel = new BroadcastChannel(`tod-status ${location.pathname}`);
const ownId = String(Math.random());

/**
 * @typedef {object} Report of a monitor
 * @property {string} id of the monitor's window
 * @property {Record<string, string>|null} status by camera; null: the monitor is being closed
 * @property {Record<string, Age>} ages by camera
 * @typedef {{age_ms: number|null, bound_ms: number}} Age of a picture
 */

/**
 * The last report of each open monitor, and when it arrived.
 * @type {Map<string, {status: Record<string, string>, ages: Record<string, Age>, at: number}>}
 */
const reports = new Map();

/** Each picture in a monitor. */
export const monitored = () => [...reports.values()].flatMap(({ status, ages }) => picturesOf(status, ages));

/** Each picture in this window. */
export const ownPictures = () => picturesOf(store.status, store.ages);

/** @param {Record<string, string>} status  @param {Record<string, Age>} ages  @returns {import("./ages.js").Picture[]} */
const picturesOf = (status, ages) => Object.keys(status).map((camera) => ({ ...(ages[camera] ?? NO_AGE), camera, status: status[camera] }));

/** @param {Record<string, string>|null} status */
const report = (status) => channel.postMessage({ id: ownId, status, ages: store.ages });

/** @param {Report} report */
function onReport({ id, status, ages }) {
  const before = reports.get(id)?.status ?? {};
  if (status) {
    reports.set(id, { status, ages, at: performance.now() });
    remind(keyOf(Object.keys(status)), null);
  } else reports.delete(id);
  const now = status ?? Object.fromEntries(Object.keys(before).map((camera) => [camera, "off"]));
  for (const camera of Object.keys(now)) if (now[camera] !== before[camera]) publishStatus(id, camera, now[camera]);
}

function checkMonitors(now) {
  for (const [id, { status, at }] of reports) if (now - at >= SILENT_MS) onSilent(id, Object.keys(status));
}

/** A monitor has crashed: the driver is alerted once, in the vehicle's order, and its pictures no longer count. */
function onSilent(id, cameras) {
  reportProblem("a monitor no longer responds: reload it");
  const mounted = (store.hello?.cameras ?? []).map(({ name }) => name).filter((name) => cameras.includes(name));
  remind(keyOf(cameras), `MONITOR NOT RESPONDING ${mounted.map(displayName).join(", ")}`);
  for (const camera of cameras) publishStatus(id, camera, "lost");
  reports.delete(id);
}

/** Of a reminder; a monitor that is reloaded has the same cameras. @param {string[]} cameras */
const keyOf = (cameras) => `monitor ${[...cameras].sort().join()}`;

/** `picture` tells apart pictures of the same camera. */
const publishStatus = (id, camera, status) => publish("monitored", { picture: `${camera} ${id}`, camera, status });

export function startMonitored() {
  if (globalThis.boot.shown) {
    let closing = false; // tasks may still run after `pagehide`: a report from one would announce this monitor again
    const reportOwn = () => closing || report(store.status);
    listen("status ages", reportOwn);
    setInterval(reportOwn, REPORT_MS);
    addEventListener("pagehide", () => {
      closing = true;
      report(null);
    });
    addEventListener("pageshow", () => (closing = false)); // the browser may restore the page from its cache
    return;
  }
  channel.onmessage = ({ data }) => onReport(data);
  checkRegularly(REPORT_MS, checkMonitors);
}
