/** What the page knows, as the station has told it; whoever shows something of it listens for the kind of message. */

const SHOWN_S = 300;
const listeners = new Map();

export const store = {
  hello: null,
  state: null,
  sample: null,
  holder: "nobody",
  connected: false,
  notes: [],
  series: emptySeries([]),
  status: {}, // by camera, as the worker judges
  ages: {}, // by camera, capture to drawing
  selected: null,
  enlarged: null,
};

/** Call `listener(payload)` for each of the kinds of message (separated by spaces). */
export function listen(kinds, listener) {
  for (const kind of kinds.split(" ")) listeners.set(kind, [...(listeners.get(kind) ?? []), listener]);
}

export function publish(kind, payload) {
  for (const listener of listeners.get(kind) ?? []) listener(payload);
}

/** Take a text message of the station into the store. */
export function take(message) {
  const { kind } = message;
  if (kind === "hello") hello(message);
  else if (kind === "state" || kind === "sample") store[kind] = message;
  else if (kind === "control") store.holder = message.holder;
  else if (kind === "history") history(message);
  else if (kind === "note") return note(message);
  if (kind === "sample") extend(message);
  publish(kind, message);
}

function hello(message) {
  store.hello = message;
  store.notes = [];
  const names = message.cameras.map(({ name }) => name);
  store.series = emptySeries(names);
  if (!names.includes(store.selected)) store.selected = names[0] ?? null;
  if (!names.includes(store.enlarged)) store.enlarged = null;
}

/** One line of news, newest first; lines of the page itself come by this way too. */
export function note({ time = Date.now() / 1000, text, level = "note" }) {
  store.notes = [{ time, text, level }, ...store.notes].sort((a, b) => b.time - a.time).slice(0, 200);
  publish("note", { time, text, level });
}

export const camera = (name) => store.hello?.cameras.find((each) => each.name === name);
export const decided = (name) => (store.state?.online ? store.state.cameras[name] : undefined);
export const mode = () => (store.state?.online ? store.state.mode : null);
export const inControl = () => store.connected && store.holder === "you";

export function select(name) {
  if (!camera(name) || store.selected === name) return;
  store.selected = name;
  publish("selected", name);
}

export function enlarge(name) {
  store.enlarged = name;
  publish("enlarged", name);
}

// --- the last five minutes, once a second -----------------------------------------------------------------------------

function emptySeries(names) {
  const columns = { time: [], predicted_kbps: [], allocated_kbps: [], actual_kbps: [], lat: [], lon: [], cameras: {} };
  for (const name of names) columns.cameras[name] = { kbps: [], allocated_kbps: [], scaling: [] };
  return columns;
}

function history(message) {
  store.series = emptySeries(Object.keys(store.series.cameras));
  for (const key of Object.keys(store.series)) if (key !== "cameras") store.series[key] = [...(message[key] ?? [])];
  for (const [name, columns] of Object.entries(store.series.cameras))
    for (const key of Object.keys(columns)) columns[key] = [...(message.cameras?.[name]?.[key] ?? [])];
}

function extend(sample) {
  const { series } = store;
  const last = series.time.at(-1);
  if (last !== undefined && sample.time < last + 0.99) return;
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
