/**
 * The worker: it holds the WebSocket and all video, so that neither charts nor dialogs of the page delay a picture.
 * Text messages from the station are passed to the page unchanged; pictures go to the canvases that it has transferred.
 */

import { ageOf, skewOf } from "./ages.js";
import { isTopView } from "./arrange.js";
import { Clock, now } from "./clock.js";
import { GroundView } from "./ground_view.js";
import { hasGpu } from "./picture.js";
import { Steering } from "./steering.js";
import { Stream } from "./stream.js";
import { drawInTurn } from "./turns.js";
// Imported here, though used only by other modules, so that all modules are fetched at once.
import "./codec.js";
import "./counter.js";
import "./framing.js";
import "./ground.js";
import "./guide_layer.js";
import "./guides.js";
import "./pace.js";
import "./projection.js";
import "./overlay.js";
import "./status.js";
import "./straight.js";
import "./straight_view.js";
import "./warp.js";
import "./yuv.js";

const WATCH_MS = 15;
const CONNECT_MS = 1000; // a station that has not answered by then is asked again
const SILENT_MS = 2000; // the station sends four messages a second
const RECONNECT_MS = 500;
const TELL_MS = 250;
const HEADER = 24;
const LOGGED = 200;

const station = {
  clock: new Clock(),
  steering: new Steering(),
  dimensions: null, // of the vehicle
  limits: { late_ms: 200, frozen_ms: 120 },
  connected: false,
  online: true,
  bound: NaN, // by how much capture times may be wrong on the station's clock, ms
  video: true,
  counted: null, // name of the camera that films the counter, if the page is to read it
  count: (counter) => send({ counter }),
  resync: (name) => send({ resync: name }),
  marked: (name, mark) => log.push([now(), name, mark]) > LOGGED && log.shift(),
  crooked,
  wake,
};
let settings = null; // of the page: {url, origin, video}
let socket = null; // null between two attempts
let moved = 0; // when it last received anything
let attempts = 0; // to reconnect
let streams = []; // in the order of hello
let described = "";
/** @type {string[]} */
let guided = []; // cameras whose guides are shown
/** @type {string|null} */
let first = null; // camera whose picture is drawn first
/** @type {string[]} */
let straight = []; // cameras whose pictures are straightened
const ground = new GroundView(station.steering);
let asleep = true;
let watched = now();
let stalled = false; // at the last tick
const log = []; // [page time, camera, mark] of each picture whose mark has changed, when that was drawn

const tell = (message) => postMessage(message);
const find = (name) => streams.find((stream) => stream.name === name);

// --- the socket -------------------------------------------------------------------------------------------------------

function connect() {
  const own = (socket = new WebSocket(settings.url));
  moved = now();
  own.binaryType = "arraybuffer";
  own.onopen = () => (moved = now());
  own.onmessage = ({ data }) => {
    moved = now();
    if (typeof data === "string") heard(JSON.parse(data));
    else unit(data);
  };
  own.onclose = drop;
}

/** Give up a connection, or an attempt at one, and retry soon. */
function drop() {
  socket.onopen = socket.onmessage = socket.onclose = null;
  socket.close();
  socket = null;
  connection(false);
  setTimeout(reconnect, RECONNECT_MS);
}

/**
 * Connect once the station answers HTTP: after many failed attempts browsers delay a page's WebSockets by seconds,
 * and this would continue when the station is back.
 */
async function reconnect() {
  const answer = await fetch("/static/video.js", { method: "HEAD", cache: "no-store", signal: AbortSignal.timeout(CONNECT_MS) }).catch(() => null);
  attempts++;
  if (answer?.ok) connect();
  else setTimeout(reconnect, RECONNECT_MS);
}

/** Drop a connection that makes no progress. */
function supervise() {
  if (!socket) return;
  const limit = socket.readyState === WebSocket.CONNECTING ? CONNECT_MS : SILENT_MS;
  if (now() - moved > limit) drop();
}

function connection(open) {
  if (station.connected === open) return;
  station.connected = open;
  if (!open) judgeAll();
  tell({ kind: "socket", open });
}

function send(message) {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(message));
  return true;
}

function heard(message) {
  if (message.kind === "clock") return station.clock.heard(message.page_ms, message.server_ms);
  if (message.kind === "steering") return station.steering.heard(message.at_ms, message.rad);
  if (message.kind === "hello") hello(message);
  if (message.kind === "state") decided(message);
  if (message.kind === "sample") station.bound = message.clock_bound_ms ?? NaN;
  tell({ kind: "server", message });
}

function hello(message) {
  station.limits = { late_ms: message.late_ms, frozen_ms: message.frozen_ms };
  const text = JSON.stringify([message.cameras, message.dimensions]);
  if (text !== described) {
    station.dimensions = message.dimensions;
    streams.forEach((stream) => stream.end());
    streams = message.cameras.map((camera) => new Stream(camera, station));
    described = text;
    guide();
    straighten();
    ground.know(streams.filter(({ camera }) => isTopView(camera)), message.dimensions);
  }
  streams.forEach((stream) => stream.started());
  connection(true);
  send({ clock: now() });
}

function decided(message) {
  if (message.online && !station.online) streams.forEach((stream) => stream.started());
  const gone = station.online && !message.online;
  station.online = message.online;
  if (gone) judgeAll(); // each picture is marked before the banner names the cause
  for (const stream of streams) if (message.cameras?.[stream.name]) stream.decide(message.cameras[stream.name]);
}

function guide() {
  for (const stream of streams) stream.guide(guided.includes(stream.name));
}

function straighten() {
  for (const stream of streams) {
    try {
      stream.straighten(straight.includes(stream.name));
    } catch (error) {
      crooked(stream, error);
    }
  }
}

/** A picture cannot be straightened: show it as it comes, and say why. */
function crooked(stream, error) {
  stream.straighten(false);
  tell({ kind: "crooked", camera: stream.name, why: error instanceof Error ? error.message : String(error) });
}

function unit(buffer) {
  const view = new DataView(buffer);
  const index = view.getUint8(0);
  streams.find(({ camera }) => camera.index === index)?.receive({
    flags: view.getUint8(1),
    sequence: view.getUint32(4, true),
    captured: view.getFloat64(8, true),
    arrived: view.getFloat64(16, true),
    data: new Uint8Array(buffer, HEADER),
  });
}

// --- drawing and watching ---------------------------------------------------------------------------------------------

function wake() {
  if (!asleep) return;
  asleep = false;
  requestAnimationFrame(() => {
    asleep = true;
    if (drawInTurn(streams, first, now)) wake();
    ground.draw();
  });
}

function watch() {
  const late = now() - watched > 3 * WATCH_MS;
  watched = now();
  // After a stall the units that arrived meanwhile are still queued: take them in first, and judge at the next tick.
  stalled = late && !stalled; // and no longer than that: a worker that is always late must judge, too
  if (stalled) return;
  supervise();
  judgeAll();
}

function judgeAll() {
  for (const stream of streams) {
    if (!stream.watch()) continue;
    tell({ kind: "status", camera: stream.name, status: stream.status, why: stream.refused });
  }
  if (asleep) ground.draw(); // the state of a picture
}

/** Report the ages that the page shows, and how far apart in time the pictures of the cameras are. */
function tellAges() {
  const bound_ms = station.bound + station.clock.bound;
  const ages = Object.fromEntries(streams.map(({ name, stages, status }) => [name, { ...ageOf(stages), bound_ms, status }]));
  const skew_ms = skewOf(streams.map(({ status, shown }) => ({ status, captured: shown?.meta.captured ?? NaN })));
  const slow = streams.filter((stream) => stream.isSlow()).length > 0; // all are to be counted
  tell({ kind: "ages", ages, skew_ms, slow });
}

// --- the page ---------------------------------------------------------------------------------------------------------

const orders = {
  start(message) {
    settings = message;
    station.keep = message.keep;
    station.counted = message.counted;
    station.video = message.video && typeof VideoDecoder !== "undefined";
    connect();
    setInterval(watch, WATCH_MS);
    setInterval(tellAges, TELL_MS);
    setInterval(() => send({ clock: now() }), 1000);
  },
  canvas: ({ name, canvas }) => find(name)?.attach(canvas),
  guides: ({ name, canvas }) => find(name)?.guides?.attach(canvas),
  guided({ names }) {
    guided = names;
    guide();
  },
  first: ({ name }) => (first = name),
  straight({ names }) {
    straight = names;
    straighten();
  },
  ground: ({ picture, lines }) => ground.attach(picture, lines),
  above: ({ shown, width, height, ratio }) => ground.show({ shown, width, height, ratio }),
  size({ name, ...display }) {
    const stream = find(name);
    if (stream) Object.assign(stream, { display, painted: null });
  },
  send: ({ message }) => tell({ kind: "sent", id: message.id, sent: send(message) }),
  async ask({ id, what, name }) {
    const questions = { measure, guides: () => find(name)?.guides?.lines, ground: () => ground.measure(), stages: allStages, picture: () => find(name)?.picture(), first: () => find(name)?.first };
    tell({ kind: "answer", id, value: await questions[what]() });
  },
};

/** Of each drawn picture: captured, arrived at the station, received here, decoded, drawn; ms on the station's clock. */
function allStages() {
  return Object.fromEntries(streams.map(({ name, stages }) => [name, stages]));
}

function measure() {
  const cameras = Object.fromEntries(streams.map((stream) => [stream.name, stream.measure(settings.origin)]));
  return { cameras, status_log: log, gpu: hasGpu, clock_offset_ms: station.clock.offset, attempts };
}

onmessage = ({ data }) => orders[data.order](data);
