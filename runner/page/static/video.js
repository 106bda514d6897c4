/**
 * The worker: it owns the WebSocket and all video, so that neither charts nor dialogs of the page delay a picture. It
 * passes text messages from the station to the page unchanged, and draws pictures on the canvases that the page transfers.
 * Some browser functions wait for the page's main thread: resizing.js, remote_warp.js and picture.js avoid that.
 */

import { ageOf, skewOf } from "./ages.js";
import { isTopView } from "./arrange.js";
import { Clock, now } from "./clock.js";
import { PLACED } from "./decoding.js";
import { described } from "./drawn_pictures.js";
import { hasEnded } from "./ended.js";
import { GroundView } from "./ground_view.js";
import { Hearing, SOUND } from "./hearing.js";
import { hasGpu } from "./picture.js";
import { startWarps } from "./remote_warp.js";
import { askPage, onPageReady } from "./resizing.js";
import { Steering } from "./steering.js";
import { MOVING } from "./status.js";
import { canStraighten } from "./straight.js";
import { Stream } from "./stream.js";
import { drawInTurn } from "./turns.js";
import { WindowView } from "./window_view.js";
// Used only by other modules, but imported here so that all modules are fetched in parallel.
import "./beginning.js";
import "./codec.js";
import "./counter.js";
import "./framing.js";
import "./ground.js";
import "./guide_lines.js";
import "./guides.js";
import "./liveness.js";
import "./pace.js";
import "./playout.js";
import "./projection.js";
import "./overlay.js";
import "./seen.js";
import "./shown_region.js";
import "./straight_view.js";
import "./stream_canvas.js";
import "./warp.js";
import "./yuv.js";

const TICK_MS = 15;
const CONNECT_MS = 1000; // timeout of an attempt to connect
const SILENT_MS = 2000; // the station sends four messages a second
const RECONNECT_MS = 500;
const REPORT_MS = 250;
const HUNG = 6; // reports without an answer of the page's main thread: keys do nothing, either
const HEADER = 24;
const REGION = 8; // bytes after it, of a unit that states its region
const MAX_LOGGED = 200;

const station = {
  clock: new Clock(),
  steering: new Steering(),
  dimensions: null, // of the vehicle
  limits: { late_ms: 200, frozen_ms: 120 },
  connected: false,
  ended: false, // whether it has ended in order, and has not returned since
  online: true,
  bound: NaN, // error bound of capture times on the station's clock, ms
  video: true,
  counted: null, // name of the camera whose counter the page reads, if any
  count: (counter) => send({ counter }),
  resync: (name) => send({ resync: name }),
  onMark: (name, mark) => log.push([now(), name, mark]) > MAX_LOGGED && log.shift(),
  onStraightenFailed,
  wake,
};
let settings = null; // of the page: {url, origin, video}
const MOST_VOICE_BYTES = 20_000; // that wait to be sent: 0.2 s
let socket = null; // null between two attempts
let receivedAt = 0; // when it last received anything
let attempts = 0; // to reconnect
let streams = []; // in the order of hello
let streamsKey = ""; // the vehicle that the streams were made for
/** @type {string[]} */
let guided = []; // cameras whose guides are shown
/** @type {string|null} */
let first = null; // camera whose picture is drawn first, and with which sound keeps step
/** @type {string[]} */
let straight = []; // cameras whose pictures are straightened
const hearing = new Hearing(station.clock, (why) => console.warn(`the vehicle's sound: ${why}`));
const ground = new GroundView(station.steering, (why) => toPage({ kind: "flat", why }));
const seen = new WindowView(ground, send);
let isAsleep = true; // no animation frame is requested
let tickedAt = now();
let wasLate = false; // at the last tick
/** @type {{attention: string, focused: boolean}|null} */
let attention = null; // of the operator, as the page states it
let reported = ""; // to the station
let holder = ""; // of control, as the station last stated it
let unanswered = 0; // reports since the page's main thread has last answered; not a time, which passes while this worker waits, too
const log = []; // [page time, camera, mark] when a changed mark was drawn

const toPage = (message) => postMessage(message);
const find = (name) => streams.find((stream) => stream.name === name);

/** Show a part of a camera's pictures only. @param {import("./framing.js").Rectangle|null} region px of the full image; null: all */
function showCrop(stream, region) {
  if (!stream) return;
  stream.region.setCrop(region);
  stream.canvas.painted_text = null; // laid out anew
}

// --- the socket -------------------------------------------------------------------------------------------------------

function connect() {
  const own = (socket = new WebSocket(holder ? `${settings.url}&before=${holder}` : settings.url));
  receivedAt = now();
  own.binaryType = "arraybuffer";
  own.onopen = () => (receivedAt = now());
  own.onmessage = ({ data }) => {
    receivedAt = now();
    if (typeof data === "string") onText(JSON.parse(data));
    else onUnit(data);
  };
  own.onclose = (event) => dropConnection(hasEnded(event));
}

/** Give up a connection, or an attempt at one, and retry soon. @param {boolean} [ended] whether the station has ended in order */
function dropConnection(ended = false) {
  socket.onopen = socket.onmessage = socket.onclose = null;
  socket.close();
  socket = null;
  setConnected(false, ended);
  setTimeout(reconnect, RECONNECT_MS);
}

/**
 * Connect once the station answers HTTP: after many failed attempts browsers delay a page's WebSockets by seconds,
 * even after the station is back.
 */
async function reconnect() {
  const request = { method: "HEAD", cache: "no-store", signal: AbortSignal.timeout(CONNECT_MS) };
  const response = await fetch("/static/video.js", /** @type {RequestInit} */ (request)).catch(() => null);
  attempts++;
  if (response?.status === 401) return toPage({ kind: "login" }); // the session has ended
  if (response?.ok) connect();
  else setTimeout(reconnect, RECONNECT_MS);
}

/** Drop a connection that makes no progress. */
function checkConnection() {
  if (!socket) return;
  const limit = socket.readyState === WebSocket.CONNECTING ? CONNECT_MS : SILENT_MS;
  if (now() - receivedAt > limit) dropConnection();
}

function setConnected(open, ended = false) {
  if (station.connected === open) return;
  Object.assign(station, { connected: open, ended });
  reported = "";
  seen.reset();
  if (!open) judgeAll();
  toPage({ kind: "socket", open, ended });
}

function send(message) {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(message));
  return true;
}

/** What the microphone hears; what the connection does not take at once would be heard too late. @param {ArrayBuffer} data */
function sendVoice(data) {
  if (socket?.readyState === WebSocket.OPEN && socket.bufferedAmount < MOST_VOICE_BYTES) socket.send(data);
}

function onText(message) {
  if (message.kind === "clock") return station.clock.onEcho(message.page_ms, message.server_ms);
  if (message.kind === "steering") return station.steering.onReport(message.at_ms, message.rad, message.gear);
  if (message.kind === "hello") onHello(message);
  if (message.kind === "state") onState(message);
  if (message.kind === "control") holder = message.holder;
  if (message.kind === "sample") onSample(message);
  toPage({ kind: "server", message });
}

function onHello(message) {
  station.limits = { late_ms: message.late_ms, frozen_ms: message.frozen_ms };
  const key = JSON.stringify([message.cameras, message.dimensions]);
  if (key !== streamsKey) {
    station.dimensions = message.dimensions;
    streams.forEach((stream) => stream.dispose());
    streams = message.cameras.map((camera) => new Stream(camera, station));
    streamsKey = key;
    applyGuides();
    applyStraight();
    ground.setCameras(streams.filter(({ camera }) => isTopView(camera)), message.dimensions);
  }
  streams.forEach((stream) => stream.resetTimes());
  setConnected(true);
  send({ clock: now() });
}

function onState(message) {
  if (message.online && !station.online) streams.forEach((stream) => stream.resetTimes());
  const wentOffline = station.online && !message.online;
  station.online = message.online;
  if (wentOffline) judgeAll(); // mark each picture before the banner names the cause
  if (message.cameras) for (const stream of streams) stream.onDecision(message.cameras[stream.name]);
}

function onSample(message) {
  station.bound = message.clock_bound_ms ?? NaN;
  for (const stream of streams) stream.live.declined = message.cameras[stream.name]?.refused ?? "";
}

function applyGuides() {
  for (const stream of streams) stream.showGuides(guided.includes(stream.name));
}

function applyStraight() {
  for (const stream of streams) stream.straighten(canStraighten(stream.camera) && straight.includes(stream.name));
}

/** A picture cannot be straightened: show the original, and report why. */
function onStraightenFailed(stream, error) {
  stream.straighten(false);
  toPage({ kind: "crooked", camera: stream.name, why: error instanceof Error ? error.message : String(error) });
}

function onUnit(buffer) {
  const view = new DataView(buffer);
  const index = view.getUint8(0);
  const receiver = index === SOUND ? hearing : streams.find(({ camera }) => camera.index === index);
  const flags = view.getUint8(1);
  const region = flags & PLACED ? regionAt(view, HEADER) : null;
  receiver?.receive({
    flags,
    sequence: view.getUint32(4, true),
    captured: view.getFloat64(8, true),
    arrived: view.getFloat64(16, true),
    data: new Uint8Array(buffer, HEADER + (region ? REGION : 0)),
    region,
  });
}

function regionAt(view, begin) {
  const [x, y, width, height] = [0, 2, 4, 6].map((offset) => view.getUint16(begin + offset, true));
  return { x, y, width, height };
}

// --- drawing and status -----------------------------------------------------------------------------------------------

function wake() {
  if (!isAsleep) return;
  isAsleep = false;
  requestAnimationFrame(() => {
    isAsleep = true;
    if (drawInTurn(streams, first, now)) wake();
    ground.draw();
  });
}

function tick() {
  const isLate = now() - tickedAt > 3 * TICK_MS;
  tickedAt = now();
  // After a stall, units that arrived meanwhile are still queued: handle them first, and judge at the next tick.
  wasLate = isLate && !wasLate; // one tick only: a worker that is always late must judge, too
  if (wasLate) return;
  checkConnection();
  judgeAll();
  if (holder === "you" && station.connected && station.video) seen.state(streams, now()); // what others see does not count
}

function judgeAll() {
  for (const stream of streams) {
    if (!stream.updateStatus()) continue;
    toPage({ kind: "status", camera: stream.name, status: stream.status, why: stream.why });
  }
  if (isAsleep) ground.draw(); // it shows the status of pictures
  if (streams.some(({ isWaiting }) => isWaiting)) wake(); // a picture that could not be straightened yet
}

/** Report the ages that the page shows, and the skew between the pictures of the cameras. */
function reportAges() {
  const bound_ms = station.bound + station.clock.bound;
  const ages = Object.fromEntries(streams.map(({ name, drawn, status }) => [name, { ...ageOf(drawn.stages, bound_ms), bound_ms, status }]));
  const skew_ms = skewOf(streams.map(({ status, shown }) => ({ status, captured: shown?.meta.captured ?? NaN })));
  const slow = streams.filter((stream) => stream.isSlow()).length > 0; // not some(): every stream counts its pictures
  toPage({ kind: "ages", ages, skew_ms, slow, steering: station.steering.newest(station.clock.toStation(now())) });
  const main = ages[first ?? ""];
  toPage({ kind: "hearing", report: hearing.report(main && MOVING.includes(main.status) ? main.age_ms : null) });
  askPage();
  unanswered++;
  reportAttention();
}

/** Report the operator's attention, which the station passes on while this page is in control; a page that hangs cannot. */
function reportAttention() {
  if (!attention) return;
  const isHung = unanswered >= HUNG && attention.attention !== "hidden";
  const state = isHung ? { attention: "slow", focused: false } : attention;
  const text = JSON.stringify(state);
  if (text !== reported && send(state)) reported = text;
}

/** Draw what waits for canvases of new sizes. */
function drawResized() {
  for (const stream of streams) stream.drawResized();
  ground.draw();
}

// --- the page ---------------------------------------------------------------------------------------------------------

const orders = {
  start(message) {
    settings = message;
    station.keep = message.keep;
    station.counted = message.counted;
    station.video = message.video && typeof VideoDecoder !== "undefined";
    connect();
    if (station.video) startWarps();
    setInterval(tick, TICK_MS);
    setInterval(reportAges, REPORT_MS);
    setInterval(() => send({ clock: now() }), 1000);
  },
  canvas({ name, canvas, lines }) {
    find(name)?.canvas.attach(canvas, lines);
    wake();
  },
  guided({ names }) {
    guided = names;
    applyGuides();
  },
  first: ({ name }) => (first = name),
  ready() {
    unanswered = 0;
    onPageReady(drawResized);
    reportAttention();
  },
  hearing: ({ port, running, latency_ms }) => hearing.attach(port, running, latency_ms),
  talking: ({ port }) => (port.onmessage = ({ data }) => sendVoice(data)),
  attention({ state, focused }) {
    attention = { attention: state, focused };
    reportAttention();
  },
  straight({ names }) {
    straight = names;
    applyStraight();
  },
  crop: ({ name, region }) => showCrop(find(name), region),
  ground: ({ picture, lines }) => ground.attach(picture, lines),
  above: ({ shown, width, height, ratio }) => ground.show({ shown, width, height, ratio }),
  size: ({ name, ...display }) => find(name)?.setDisplay(display),
  send: ({ message }) => toPage({ kind: "sent", id: message.id, sent: send(message) }),
  async ask({ id, what, name }) {
    const questions = {
      measure,
      guides: () => find(name)?.canvas.guideLines(),
      ground: () => ground.measure(),
      stages: allStages,
      stated: () => seen.stated.map(([time, view]) => [station.clock.toStation(time), view]),
      shown: () => Object.fromEntries(streams.map((stream) => [stream.name, stream.drawn.shown])),
      picture: () => described(find(name)?.shown),
      first: () => find(name)?.first,
    };
    toPage({ kind: "answer", id, value: await questions[what]() });
  },
};

/** Times of each drawn picture: captured, arrived at the station, received here, decoded, drawn; ms on the station's clock. */
function allStages() {
  return Object.fromEntries(streams.map(({ name, drawn }) => [name, drawn.stages]));
}

function measure() {
  const cameras = Object.fromEntries(streams.map((stream) => [stream.name, stream.measure(settings.origin)]));
  return { cameras, status_log: log, gpu: hasGpu, clock_offset_ms: station.clock.offset, attempts };
}

onmessage = ({ data }) => orders[data.order](data);
