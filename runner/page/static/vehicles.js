/** The vehicles of this station, each as a card: on the page that lists them, and beside the pictures of one of them. */

import { hasEnded } from "./ended.js";
import { make, setAttribute, setText } from "./format.js";
import { alarmsOf, driverOf, figuresOf, isHeldHere, pictureOf, stateOf, toWatcher } from "./vehicle_words.js";

const AGAIN_MS = 1000; // between two attempts to connect
const SILENT_MS = 3000; // the server sends four lists a second
const WATCHED = "tod-watched"; // names of the vehicles whose small picture is on

/** @typedef {import("./vehicle_words.js").Row} Row */

export const pageOf = (name) => `/vehicle/${name}/`;

/** The names in this tab's storage. @returns {Set<string>} */
const watched = () => new Set(sessionStorage.getItem(WATCHED)?.split(" ").filter(Boolean));

/** One vehicle of the list. */
class Card {
  /**
   * @param {string} name
   * @param {(name: string) => boolean} mayLeave whether another vehicle may be opened now
   * @param {(name: string) => void} release called to release control of it
   */
  constructor(name, mayLeave, release) {
    this.name = name;
    this.camera = ""; // of the small picture, "" while there is none
    const names = ["state", "driver", "speed", "latency", "link"];
    this.parts = Object.fromEntries(names.map((part) => [part, make("span", { class: part })]));
    this.alarms = make("ul", { class: "alarms", role: "status", "aria-label": `Alarms of ${name}` });
    this.view = make("div", { class: "view", hidden: true });
    this.watch = make("button", { class: "watch", "aria-pressed": "false", onclick: () => this.toggle() }, "Picture");
    this.release = make("button", { class: "release", hidden: true, onclick: () => release(name) }, "Release");
    const onclick = (event) => mayLeave(name) || event.preventDefault();
    const open = make("a", { class: "open", href: pageOf(name), onclick }, "Open");
    const { state, driver, speed, latency, link } = this.parts;
    const figures = make("dl", {}, ...[["Speed", speed], ["Latency", latency], ["Link", link]].map(([title, value]) =>
      make("div", {}, make("dt", {}, title), make("dd", {}, value))));
    this.element = make("article", { class: "vehicle-card", "aria-label": name },
      make("header", {}, make("h2", {}, name), state), driver, figures, this.alarms, this.view,
      make("div", { class: "buttons" }, open, this.watch, this.release));
  }

  toggle() {
    const names = watched();
    if (!names.delete(this.name)) names.add(this.name);
    sessionStorage.setItem(WATCHED, [...names].join(" "));
    this.refreshPicture();
  }

  /** @param {Row} row  @param {boolean} isCurrent whether it is the vehicle of this page */
  show(row, isCurrent) {
    this.row = row;
    const words = { state: stateOf(row), driver: driverOf(row) };
    for (const [part, { level, text }] of Object.entries(words)) {
      setText(this.parts[part], text);
      setAttribute(this.parts[part], "data-level", level);
    }
    for (const [part, text] of Object.entries(figuresOf(row))) setText(this.parts[part], text);
    this.release.hidden = !isHeldHere(row);
    const alarms = alarmsOf(row);
    if (this.alarms.textContent !== alarms.join("")) this.alarms.replaceChildren(...alarms.map((text) => make("li", {}, text)));
    setAttribute(this.element, "data-alarm", alarms.length > 0 || words.state.level === "late" ? "" : null);
    setAttribute(this.element, "aria-current", isCurrent ? "page" : null);
    this.refreshPicture(isCurrent);
  }

  /** The small picture is a monitor of its own: it marks what is late, damaged, frozen or lost as every other does. */
  refreshPicture(isCurrent = false) {
    const isOn = watched().has(this.name) && !isCurrent;
    const camera = isOn && this.row ? (pictureOf(this.row) ?? this.camera) : "";
    setAttribute(this.watch, "aria-pressed", isOn);
    this.view.hidden = !camera;
    if (camera === this.camera) return;
    this.camera = camera;
    const src = `${pageOf(this.name)}?show=${encodeURIComponent(camera)}`;
    this.view.replaceChildren(...(camera ? [make("iframe", { src, title: `${this.name}, ${camera}`, inert: true })] : []));
  }
}

/**
 * Show the vehicles in an element.
 * @param {HTMLElement} element
 * @param {object} options
 * @param {string|null} options.current name of the vehicle of this page
 * @param {(name: string) => boolean} options.mayLeave whether a vehicle may be opened now in place of the current one
 * @param {(rows: Row[]|null, ended?: boolean) => void} [options.onRows] called with each list; null: there is no connection,
 *   ended: because the server has ended in order
 */
export function startVehicles(element, { current, mayLeave, onRows = () => {} }) {
  /** @type {Map<string, Card>} */
  const cards = new Map();

  /** @param {Row[]} rows */
  function show(rows) {
    for (const row of rows) {
      if (!cards.has(row.name)) {
        cards.set(row.name, new Card(row.name, mayLeave, release));
        element.append(cards.get(row.name)?.element ?? "");
      }
      cards.get(row.name)?.show(row, row.name === current);
    }
    onRows(rows);
  }

  const release = follow((rows, ended) => {
    setAttribute(element, "data-stale", rows ? null : "");
    if (rows) show(rows);
    else onRows(null, ended);
  });
}

/**
 * Call a function with each list that the server sends; null: it sends none.
 * @param {(rows: Row[]|null, ended?: boolean) => void} onList
 * @returns {(name: string) => void} releases control of a vehicle
 */
function follow(onList) {
  const url = new URL("/list", location.href);
  url.protocol = url.protocol.replace("http", "ws");
  let heard = performance.now();
  let socket = connect();

  function connect() {
    const own = new WebSocket(url);
    own.onmessage = ({ data }) => {
      heard = performance.now();
      const { vehicles, may_drive } = JSON.parse(data);
      onList(may_drive ? vehicles : vehicles.map(toWatcher));
    };
    own.onclose = (event) => own === socket && again(hasEnded(event));
    return own;
  }

  function again(ended = false) {
    onList(null, ended);
    setTimeout(async () => {
      const answer = await fetch("/static/vehicles.js", { method: "HEAD", cache: "no-store" }).catch(() => null);
      if (answer?.status === 401) return location.assign("/login");
      heard = performance.now();
      if (answer?.ok) socket = connect();
      else again(ended);
    }, AGAIN_MS);
  }

  setInterval(() => {
    if (performance.now() - heard > SILENT_MS && socket.readyState <= WebSocket.OPEN) {
      heard = performance.now();
      socket.close();
    }
  }, AGAIN_MS);
  return (name) => socket.readyState === WebSocket.OPEN && socket.send(name);
}
