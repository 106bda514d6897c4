/** Who drives, and the buttons by which operators pass control on. */

import { decisionOf, driverView, inControl, listen, onlyWatches, publish, store, who } from "./store.js";
import { pending, reportProblem, showProblem, submit, whyNoControl } from "./requests.js";
import { send } from "./link.js";
import { withKey } from "./hints.js";
import { Holding } from "./holding.js";
import { choicesOf, driverWords, endedWords, handOverWords, LivePictures, speedWords, stopWords } from "./driving.js";
import { byId, clockTime, displayName, make, setAttribute, setText } from "./format.js";

/** @typedef {import("./driving.js").Choice} Choice */

const LEVELS = { you: "you", another: "another", operator: "another", lost: "another", unheard: "another" };
const UNHEARD = "the vehicle receives nothing from this station";

const holding = new Holding();
const pictures = new LivePictures();
let asked = ""; // by operators of this one, at the last look
/** @type {import("./driving.js").Driving|null} */
let known = null; // who drove then
/** @type {string|null} */
let offeredTo = null; // to whom this station's operator offered control when it last had it
const confirmed = byId("confirm", HTMLDialogElement);
const offering = byId("offer-to", HTMLDialogElement);
/** @type {Choice|null} */
let confirming = null;

/** Cameras that are sent, but whose picture has not been live here for long enough. */
function unseen() {
  const seen = pictures.seen(performance.now());
  return (store.hello?.cameras ?? []).map(({ name }) => name).filter((name) => decisionOf(name)?.sending && !seen.includes(name));
}

const timeOf = (time) => (time ? clockTime(time).slice(0, 5) : "");
const view = () => ({ ...driverView(), unseen: unseen().map(displayName), absentAt: timeOf(store.state?.absent_since) });

/** Whether the vehicle hears nothing from this station, and has had time to. */
export const isUnheard = () => who() === "unheard" && holding.isSettled(performance.now());

// --- what the driver is told ------------------------------------------------------------------------------------------

/** Notice that this page has gained, passed on or lost control, and what other operators ask. A monitor's page tells. */
function watch() {
  const [now, { driving, own }] = [who(), driverView()];
  const given = now === "operator" && driving?.holder === offeredTo ? "offered" : driving?.released === own ? "released" : null;
  const change = holding.update(now, given, performance.now());
  if (driving?.state === "held" && driving.holder === own) offeredTo = driving.offered;
  if (change === "passed" || (change === "gained" && store.view !== "monitor")) onPassed(change);
  if (store.view === "monitor") return;
  if (change === "lost") reportLoss(lossWords());
  watchRequests();
}

function onPassed(change) {
  const { driving } = store;
  const text = change === "gained" ? "You are in control" : `${driving?.holder} drives now`;
  publish("toast", { text, level: "hint" });
  if (!driving?.standing) publish("passed");
}

function watchRequests() {
  const { driving, own } = driverView();
  const to = driving?.offered === own ? [`${driving.holder} offers you control`] : [];
  const from = inControl() ? (driving?.requested ?? []).map((name) => `${name} asks for control`) : [];
  const now = [...to, ...from].join("; ");
  if (now && now !== asked && store.holder === "you") publish("asked");
  asked = now;
  const ended = endedWords(known, driving, own);
  if (ended && store.holder === "you") publish("toast", { text: ended, level: "hint" });
  known = driving;
}

function reportLoss(why) {
  reportProblem(`CONTROL LOST: ${why}`);
  publish("deposed");
}

function lossWords() {
  const now = who();
  if (now === "unheard") return UNHEARD;
  const words = driverWords(now, store.driving);
  return words.charAt(0).toLowerCase() + words.slice(1);
}

/** What is wrong with this page's control, for its driver; null: nothing, or it has never had any. */
export function controlWarning() {
  if (!holding.isLost || inControl()) return null;
  if (store.view !== "monitor" && who() === "another") return `CONTROL LOST: ${withKey("this page only watches; take control", "control")}`;
  if (store.view !== "monitor") return `CONTROL LOST: ${whyNoControl()}`;
  return `CONTROL LOST: ${store.abandoned ? "the page of this monitor is closed" : "take control on the page of this monitor"}`;
}

// --- what the driver does ---------------------------------------------------------------------------------------------

/** The first button, by its key. */
export function toggleControl() {
  if (!store.connected) return;
  if (onlyWatches()) return showProblem(whyNoControl());
  if (store.view === "monitor") return showProblem("only the page can take or release control, not its monitors");
  const [first] = choicesOf(view());
  choose(first);
}

/** @param {Choice} choice */
function choose(choice) {
  if (choice.why) return showProblem(choice.why);
  if (choice.takers) return chooseTaker(choice.takers);
  if (!choice.from) return carryOut(choice);
  confirming = choice;
  refreshConfirm();
  confirmed.showModal();
}

/** @param {Choice} choice */
function carryOut({ event, text }) {
  if (store.holder !== "you") send({ take_control: true });
  if (!event) return;
  const { event: name } = event;
  const live = name === "control_accepted" ? { live: pictures.seen(performance.now()) } : {};
  submit("control", { ...event, ...live }, text.toLowerCase());
}

/** Whoever is to drive next, of those who have not asked. @param {string[]} names */
function chooseTaker(names) {
  const offer = (name) => () => {
    offering.close();
    carryOut({ text: `Offer control to ${name}`, event: { event: "control_offered", to: name } });
  };
  byId("takers").replaceChildren(...names.map((name) => make("button", { class: "strong", onclick: offer(name) }, name)));
  offering.showModal();
}

/** The speed is current while the question is open. */
function refreshConfirm() {
  if (!confirming) return;
  const speed = speedWords(store.sample?.position?.speed_mps);
  const { driving } = store;
  const from = {
    page: "Another page is in control of this vehicle. Take control from it?",
    operator: `Operator ${driving?.holder} ${driving?.state === "lost" ? "is lost" : "drives"}, the vehicle goes ${speed}. Take control?`,
  };
  setText(byId("confirm-text"), from[confirming.from ?? "page"]);
}

function onConfirmed() {
  if (confirming && confirmed.returnValue === "yes") carryOut(confirming);
  confirming = null;
  confirmed.returnValue = "";
}

// --- what is shown ----------------------------------------------------------------------------------------------------

const GROUPS = [["holder", "control", "take-control"], ["drive-holder", "drive-controls", "drive-control"]];
const made = new Map(); // by group of buttons, what they were made of

function refresh() {
  const now = view();
  const [choices, isKnown] = [choicesOf(now), store.connected && now.online];
  const usual = choices.filter(({ isAnswer }) => !isAnswer);
  for (const [words, group, first] of GROUPS) {
    setText(byId(words), isKnown ? driverText() : "");
    setAttribute(byId(words), "data-holder", LEVELS[who()] ?? "nobody");
    setAttribute(byId(words), "title", now.own && `you are operator ${now.own}`);
    showButtons(group, usual, choices[0], first);
  }
  const stop = stopWords(now.driving, now.own, timeOf(store.state?.stop_since));
  const words = [stop, store.view === "monitor" ? "" : handOverWords(now)].filter(Boolean);
  const text = isKnown ? words.join(". ") : "";
  byId("hand-over").hidden = !text;
  setAttribute(byId("hand-over"), "data-stop", stop ? "true" : null);
  setText(byId("hand-over-words"), text);
  showButtons("answers", choices.filter(({ isAnswer }) => isAnswer), choices[0], "answer");
}

function driverText() {
  const since = timeOf(store.state?.held_since);
  const words = who() !== "unheard" || isUnheard() ? driverWords(who(), store.driving) : "";
  return words && since ? `${words} since ${since}` : words;
}

/**
 * @param {string} group  @param {Choice[]} choices
 * @param {Choice} keyed the one that the key chooses
 * @param {string} id of the first button
 */
function showButtons(group, choices, keyed, id) {
  const requested = pending("control")?.description;
  const now = JSON.stringify([choices, choices[0] === keyed, requested, withKey("", "control")]);
  if (made.get(group) === now) return;
  made.set(group, now);
  const focused = [...byId(group).children].findIndex((button) => button === document.activeElement);
  const buttons = choices.map((choice, i) => {
    const { text, why = null, hint = text } = choice;
    return make("button", {
      id: i === 0 && id, class: isMain(choice) && "strong", title: why ?? (choice === keyed ? withKey(hint, "control") : hint),
      "aria-disabled": why && "true", "data-pending": requested === text.toLowerCase(), onclick: () => choose(choice),
    }, choice === keyed && choice.isAnswer ? withKey(text, "control") : text);
  });
  byId(group).replaceChildren(...buttons);
  buttons[focused]?.focus({ preventScroll: true });
}

const ASIDE = ["Release", "Accept without pictures", "Lift stop"];
/** Whether a button is what its person most likely wants next. @param {Choice} choice */
const isMain = ({ text, why, takers, from }) =>
  !why && !ASIDE.includes(text) && !text.startsWith("Decline") && !takers && from !== "operator";

export function startControl() {
  confirmed.addEventListener("close", onConfirmed);
  listen("status", () => pictures.update(store.status, performance.now()));
  listen("hello control state ages socket", watch);
  listen("hello control state ages socket requests link view", refresh);
  listen("sample", refreshConfirm);
  refresh();
}
