/** The page's state, as received from the station; views listen for the kinds of messages that they show. */

import { BIRDSEYE } from "./arrange.js";
import { whoDrives } from "./driving.js";

const SHOWN_S = 300;
const UNDRIVEN = ["free", "nobody", "unknown"];
const SAMPLE_MS = 1000; // the station sends four samples a second
const listeners = new Map();
let sampledAt = -Infinity; // page time of the last sample

/**
 * The part of the station's messages that the page uses.
 * @typedef {import("./records.js").CameraState & {applied: Applied}} Decision
 * @typedef {import("./records.js").VehicleState & {cameras: Record<string, Decision>} & Since} State
 * @typedef {{held_since: number|null, stop_since: number|null, absent_since: number|null}} Since
 *   held_since: since when its holder is in control, or was until it was lost; stop_since: since when a stop that was asked
 *   for stands; absent_since: since when the page of the holder is closed; s since 1970
 * @typedef {import("./records.js").Sample & {time: number}} Sample time: s since 1970
 * @typedef {object} Camera of hello
 * @property {string} name
 * @property {number} index among the vehicle's cameras, of which a monitor shows some
 * @property {number} width px
 * @property {number} height px
 * @property {number} fps
 * @property {boolean} passed whether its pictures come as the camera encodes them
 * @property {boolean} settable of these, whether its bitrate can be set in the camera
 * @property {number|null} wave_s length of a refresh wave, or time between key frames; null: unknown
 * @property {import("./projection.js").Pose|null} pose
 * @property {number} fov_deg
 * @property {"pinhole"|"fisheye"} lens
 * @property {{width: number, height: number, left: number, top: number}} native
 * @property {boolean} calibrated whether these were measured
 * @property {"fit"|"fill"|null} framing of its picture in the Drive view; null: depends on its place
 * @property {string|null} codec
 * @property {number} weight
 * @property {number[]} scaling factors, rising
 * @property {number} b_full_kbps
 * @typedef {{vehicle: string, cameras: Camera[], layout: Layout, selected: string|null,
 *   dimensions: import("./guides.js").Dimensions|null, inputs: Inputs, operator: string, answer_s: number,
 *   late_ms: number, sound?: boolean, voice?: boolean, visitor: {name: string, may_drive: boolean}}} Hello
 * visitor: who has logged in, "" on the station's own machine; selected: in another window of this page; operator: this
 *   station's; answer_s: the station answers a request within this time; late_ms: a picture older than this is late
 * @typedef {{keys: Record<string, string|null>, buttons: Record<string, number|string|null>}} Inputs by action
 * @typedef {{places: Places, own: Places, saved: boolean, drive: import("./placing.js").Places|null, problem: string|null}} Layout
 *   of the Configure view: places in force, the vehicle's own, and whether others were saved; saved places of the Drive view;
 *   and why a layout cannot be saved
 * @typedef {import("./layout.js").Places} Places
 * @typedef {object} Applied the values read back from the elements
 * @property {boolean} [sending]
 * @property {number} [bitrate] kbit/s
 * @property {{width: number, height: number}} [size] px
 * @property {import("./records.js").Roi} [roi]
 * @typedef {{fault: string|null, expiring: string[]}} Link
 * of the station to the broker: why there is none, and which certificates expire soon
 * @typedef {{time: number, text: string, level: string, own: boolean}} Note own: the page's, not the station's
 */

/** @typedef {(number|null)[]} Column */
/** @typedef {{kbps: Column, allocated_kbps: Column, scaling: Column}} CameraColumns */

/**
 * @typedef {object} Store
 * @property {Hello|null} hello
 * @property {State|null} state
 * @property {import("./driving.js").Driving|null} driving as the vehicle last published it; null: not yet
 * @property {Sample|null} sample null: none yet, or none for a second
 * @property {Link} link
 * @property {string} holder which of the station's pages acts for it: you, another or nobody; unknown: not told since it connected
 * @property {string[]} watching
 * @property {boolean} abandoned
 * @property {boolean} elsewhere
 * @property {boolean} covered
 * @property {boolean} connected
 * @property {boolean} ended
 * @property {boolean} hung
 * @property {Note[]} notes
 * @property {ReturnType<typeof emptySeries>} series
 * @property {Map<string, string>} reminders
 * @property {Record<string, string>} status
 * @property {Record<string, string>} refused
 * @property {Record<string, {age_ms: number|null, bound_ms: number, parts_ms: {page: number, decode: number, draw: number}|null}>} ages
 * @property {number|null} skew_ms
 * @property {boolean} slow
 * @property {{rad: number, gear?: string}|null} steering
 * @property {string|null} selected
 * @property {string|null} enlarged camera, or BIRDSEYE
 * @property {"configure"|"drive"|"monitor"} view
 */

/** @type {Store} */
export const store = {
  hello: null,
  state: null,
  driving: null,
  sample: null,
  link: { fault: null, expiring: [] },
  holder: "unknown",
  watching: [], // names of those who only watch, on a page that may drive
  abandoned: false, // whether no page acts for the station because the one that did has closed
  elsewhere: false, // whether another window of this page has the keyboard focus
  covered: false, // whether another window of this page is hidden
  connected: false,
  ended: false, // whether the station has ended in order, and has not returned since
  hung: false, // whether the worker does not respond: nothing is known then
  notes: [],
  series: emptySeries([]),
  reminders: new Map(), // by key, what the driver is reminded of until it is settled, or the page no longer has control
  status: {}, // by camera, as judged by the worker
  refused: {}, // by camera, why there is no picture to show, or ""
  ages: {}, // by camera, latency from capture to drawing, its error bound, and its parts on the page
  slow: false, // whether too few of the received pictures are drawn
  steering: null, // as last reported; null: not in the last second
  skew_ms: null, // between the capture times of the oldest and the newest picture shown
  selected: null,
  enlarged: null,
  view: "configure",
};

/** Call `listener(payload)` for messages of these kinds (separated by spaces). */
export function listen(kinds, listener) {
  for (const kind of kinds.split(" ")) listeners.set(kind, [...(listeners.get(kind) ?? []), listener]);
}

/** A key of the browser's storage for a choice about this vehicle's cameras: another vehicle's may not be calibrated. */
export const ofVehicle = (key) => `${key}:${store.hello?.vehicle}`;

listen("sample", () => (sampledAt = performance.now()));

/** Drop a sample that no other has followed: its values would look current. To be called a few times a second. */
export function dropOldSample(now = performance.now()) {
  if (!store.sample || now - sampledAt <= SAMPLE_MS) return;
  store.sample = null;
  publish("sample", null);
}

export function publish(kind, payload) {
  for (const listener of listeners.get(kind) ?? []) listener(payload);
}

/** Store a text message from the station, and publish it. */
export function onStationMessage(message) {
  const { kind } = message;
  const { selected } = store;
  if (kind === "hello") onHello(message);
  else if (kind === "state" || kind === "sample" || kind === "link") store[kind] = message;
  else if (kind === "control") onControl(message);
  else if (kind === "layout" && store.hello) store.hello.layout = message;
  else if (kind === "selection") return setSelected(message.camera);
  else if (kind === "history") onHistory(message);
  else if (kind === "note") return note({ ...message, own: false });
  if (kind === "sample") appendSample(message);
  if (kind === "state") onState(message);
  publish(kind, message);
  if (store.selected !== selected) publish("selected", store.selected); // by a hello: another window has selected it meanwhile
}

function onControl({ holder, abandoned, elsewhere, covered, watching = [] }) {
  Object.assign(store, { holder, abandoned, elsewhere, covered, watching });
  forgetReminders();
}

/** While the vehicle is offline, what it published last counts. @param {State} state */
function onState({ online, driving }) {
  if (online) store.driving = driving ?? null;
  forgetReminders();
}

function forgetReminders() {
  if (!["you", "unknown"].includes(who())) store.reminders.clear();
}

/** Remind whoever drives of something until it is settled: text null. @param {string} key  @param {string|null} text */
export function remind(key, text) {
  if (text === null ? !store.reminders.delete(key) : !inControl()) return;
  if (text !== null) store.reminders.set(key, text);
  publish("reminders");
}

function onHello(message) {
  const mounted = ({ cameras, dimensions }) => JSON.stringify([cameras, dimensions]); // for which the worker makes new streams
  if (store.hello && mounted(store.hello) !== mounted(message)) Object.assign(store, { status: {}, refused: {} });
  store.hello = message;
  store.notes = store.notes.filter(({ own }) => own); // the station sends its own again
  const names = message.cameras.map(({ name }) => name);
  store.series = emptySeries(names);
  const own = store.view === "monitor" || names.includes(store.selected) ? store.selected : (names[0] ?? null);
  store.selected = message.selected ?? own;
  if (store.enlarged !== BIRDSEYE && !names.includes(store.enlarged)) store.enlarged = null;
}

/**
 * Add an event to the list, from the station or from the page itself; newest first.
 * @param {{time?: number, text: string, level?: string, own?: boolean}} note own: the page's
 */
export function note({ time = Date.now() / 1000, text, level = "note", own = true }) {
  store.notes = [{ time, text, level, own }, ...store.notes].sort((a, b) => b.time - a.time).slice(0, 200);
  publish("note", { time, text, level });
}

/** @param {string|null|undefined} name */
export const camera = (name) => store.hello?.cameras.find((each) => each.name === name);
/**
 * @param {string|null} name
 * @returns {Decision|undefined}
 */
export const decisionOf = (name) => (store.state?.online && name ? store.state.cameras[name] : undefined);
/**
 * Why there is no decision about a camera; "": there is one.
 * @param {string} name
 */
export function whyUndecided(name) {
  if (!store.state?.online) return store.link.fault ? "There is no control link." : "The vehicle is offline.";
  return decisionOf(name) ? "" : `The vehicle has no camera ${name}.`;
}
export const mode = () => (store.state?.online ? store.state.mode : null);
/** Whether this page's visitor may only watch. */
export const onlyWatches = () => store.hello?.visitor.may_drive === false;

/** What this page knows of who drives. @returns {import("./driving.js").View} */
export function driverView() {
  const [own, page] = [store.hello?.operator ?? "", store.connected ? store.holder : "unknown"];
  return { driving: store.driving, own, page, online: store.state?.online === true };
}

/** Who drives: the one truth that all of the page reads. */
export const who = () => whoDrives(driverView());
export const inControl = () => who() === "you";

/**
 * A camera's status as far as the driver must be alerted to it: pauses while nobody drives, and those by a weight of 0,
 * are intended, and so is that an operator who does not drive gets no pictures.
 * @param {string} name  @param {string|undefined} status of its picture
 */
export function alertStatus(name, status = store.status[name]) {
  if (status === "refused") return inControl() ? status : "off";
  const isUnshared = mode() !== "single" && decisionOf(name)?.weight === 0;
  return status === "paused" && (UNDRIVEN.includes(who()) || isUnshared) ? "off" : status;
}

/** Select a camera in all windows of this page. */
export function select(name) {
  if (!camera(name) || store.selected === name) return;
  setSelected(name);
  publish("chosen", name);
}

/** Set the selection; a monitor may not show that camera. */
function setSelected(name) {
  store.selected = name;
  publish("selected", name);
}

/** @param {string|null} name */
export function enlarge(name) {
  store.enlarged = name;
  publish("enlarged", name);
}

// --- the last five minutes, one sample per second ---------------------------------------------------------------------

/** @param {string[]} names */
function emptySeries(names) {
  /** @type {Record<string, CameraColumns>} */
  const cameras = Object.fromEntries(names.map((name) => [name, { kbps: [], allocated_kbps: [], scaling: [] }]));
  /** @type {Record<"predicted_kbps"|"allocated_kbps"|"actual_kbps"|"lat"|"lon", Column> & {time: number[]}} */
  const columns = { time: [], predicted_kbps: [], allocated_kbps: [], actual_kbps: [], lat: [], lon: [] };
  return { ...columns, cameras };
}

function onHistory(message) {
  store.series = emptySeries(Object.keys(store.series.cameras));
  for (const key of Object.keys(store.series)) if (key !== "cameras") store.series[key] = [...(message[key] ?? [])];
  for (const [name, columns] of Object.entries(store.series.cameras))
    for (const key of Object.keys(columns)) columns[key] = [...(message.cameras?.[name]?.[key] ?? [])];
}

function appendSample(sample) {
  const last = store.series.time.at(-1);
  const wasSetBack = last !== undefined && sample.time < last - 0.99; // the clock
  if (wasSetBack) store.series = emptySeries(Object.keys(store.series.cameras));
  else if (last !== undefined && sample.time < last + 0.99) return;
  const { series } = store;
  push(series, "time", sample.time);
  for (const key of ["predicted_kbps", "allocated_kbps", "actual_kbps"]) push(series, key, sample[key]);
  for (const key of ["lat", "lon"]) push(series, key, sample.position?.[key]);
  for (const [name, columns] of Object.entries(series.cameras))
    for (const key of Object.keys(columns)) push(columns, key, sample.cameras[name]?.[key]);
}

function push(columns, key, value) {
  columns[key].push(value ?? null);
  if (columns[key].length > SHOWN_S) columns[key].shift();
}
