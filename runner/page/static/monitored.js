/** The statuses of the pictures in monitors, reported to the pages of the same browser: the page in control alerts its driver. */

import { listen, publish, store } from "./store.js";

const REPORT_MS = 500;
const FORGET_MS = 3000; // a closed monitor no longer reports; browsers run the timers of a hidden one once a second
const channel = new BroadcastChannel("tod-status");
const ownId = String(Math.random());

/**
 * @typedef {object} Report of a monitor
 * @property {string} id of the monitor's window
 * @property {Record<string, string>} status by camera
 */

/** The last report of each monitor, and when it arrived. @type {Map<string, {status: Record<string, string>, at: number}>} */
const reports = new Map();

/** Each picture in a monitor. @returns {{camera: string, status: string}[]} */
export const monitored = () => [...reports.values()].flatMap(({ status }) => Object.keys(status).map((camera) => ({ camera, status: status[camera] })));

const report = () => channel.postMessage({ id: ownId, status: store.status });

/** @param {Report} report */
function onReport({ id, status }) {
  const before = reports.get(id)?.status ?? {};
  reports.set(id, { status, at: performance.now() });
  for (const camera of Object.keys(status)) if (status[camera] !== before[camera]) publishStatus(id, camera, status[camera]);
}

function forgetClosed() {
  for (const [id, { status, at }] of reports) {
    if (performance.now() - at < FORGET_MS) continue;
    reports.delete(id);
    for (const camera of Object.keys(status)) publishStatus(id, camera, "off");
  }
}

/** `picture` tells apart pictures of the same camera. */
const publishStatus = (id, camera, status) => publish("monitored", { picture: `${camera} ${id}`, status });

export function startMonitored() {
  if (globalThis.boot.shown) {
    listen("status", report);
    setInterval(report, REPORT_MS);
    return;
  }
  channel.onmessage = ({ data }) => onReport(data);
  setInterval(forgetClosed, REPORT_MS);
}
