/** Who drives from a page's point of view, and the buttons that its person gets. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { choicesOf, driverWords, endedWords, handOverWords, LivePictures, speedWords, stopWords, whoDrives } from "../../runner/page/static/driving.js";

const NONE = { state: "free", holder: null, since: 0, offered: null, offer_ends: null, requested: [], stop: null, stop_since: null, released: null, standing: true, why: "" };
const PRESENT = { anna: "controller", bob: "controller", eve: "watcher" };

/** @returns {any} what the page of anna's station sees */
const seen = (driving = {}, more = {}) => ({ driving: { ...NONE, present: PRESENT, ...driving }, own: "anna", page: "you", online: true, ...more });
const held = (holder, more = {}) => ({ state: "held", holder, ...more });
const texts = (view) => choicesOf(view).map(({ text, why }) => (why ? `${text}: ${why}` : text));

test("who drives follows from the vehicle's record and the page that acts for the station", () => {
  const table = [
    [seen(), "free"],
    [seen({ present: { bob: "controller" } }), "unheard"],
    [seen(held("anna")), "you"],
    [seen(held("anna"), { page: "another" }), "another"],
    [seen(held("anna"), { page: "nobody" }), "nobody"],
    [seen(held("anna"), { page: "unknown" }), "unknown"],
    [seen(held("bob")), "operator"],
    [seen(held("bob"), { page: "another" }), "operator"],
    [seen({ state: "lost", holder: "bob" }), "lost"],
    [seen({ state: "lost", holder: "anna" }), "unheard"],
    [seen({}, { driving: null }), "unknown"],
  ];
  for (const [view, who] of table) assert.equal(whoDrives(view), who);
  assert.deepEqual(["operator", "lost"].map((who) => driverWords(/** @type {any} */ (who), /** @type {any} */ (held("bob")))), ["Operator bob is in control", "Operator bob is lost"]);
});

test("the driver offers control to those who ask before others", () => {
  assert.deepEqual(texts(seen(held("anna", { present: { anna: "controller" } }))), ["Release"]);
  assert.deepEqual(texts(seen(held("anna"))), ["Release", "Offer …"]);
  assert.deepEqual(choicesOf(seen(held("anna")))[1].takers, ["bob"], "not to a watcher");
  assert.deepEqual(texts(seen(held("anna", { requested: ["bob"] }))), ["Offer control to bob", "Decline bob", "Release"]);
  assert.deepEqual(texts(seen(held("anna", { offered: "bob", requested: ["bob"] }))), ["Withdraw offer", "Release"]);
});

test("an operator who does not drive asks, waits for the pictures, and accepts", () => {
  assert.deepEqual(texts(seen()), ["Take control"]);
  assert.deepEqual(texts(seen(held("bob"))), ["Request control"]);
  assert.deepEqual(texts(seen(held("bob", { requested: ["anna"] }))), ["Withdraw request"]);
  const offered = held("bob", { offered: "anna", standing: false });
  assert.deepEqual(texts(seen(offered, { unseen: ["front left", "rear"] })), ["Accept control: not live for 1 s yet: front left, rear", "Decline"]);
  const standing = seen({ ...offered, standing: true }, { unseen: ["rear"] });
  assert.deepEqual(texts(standing), ["Accept control: not live for 1 s yet: rear", "Accept without pictures", "Decline"]);
  assert.deepEqual(texts(seen(offered, { page: "another" })), ["Accept control", "Decline"], "any page of the station may act");
});

test("who waited for control is told when nothing comes of it", () => {
  const bob = (more = {}) => seen(held("bob", more)).driving;
  const [offered, asked] = [bob({ offered: "anna" }), bob({ requested: ["anna"] })];
  assert.equal(endedWords(offered, bob(), "anna"), "The offer of control has ended: bob drives");
  assert.equal(endedWords(offered, bob(), "bob"), "anna has not taken control: you drive");
  assert.equal(endedWords(asked, bob(), "anna"), "Your request for control has ended: bob drives");
  assert.equal(endedWords(asked, bob({ offered: "anna" }), "anna"), "");
  assert.equal(endedWords(offered, seen(held("anna")).driving, "anna"), "");
  assert.equal(endedWords(null, bob(), "anna"), "");
});

test("a supervisor may take control, after confirming", () => {
  const present = { ...PRESENT, anna: "supervisor" };
  const choices = choicesOf(seen(held("bob", { present })));
  assert.deepEqual(choices.map(({ text, from }) => [text, from]), [["Request control", undefined], ["Take control", "operator"]]);
  assert.deepEqual([8.1, 0, undefined].map(speedWords), ["at 29 km/h", "at 0 km/h", "at a speed that is not known, which counts as moving"]);
});

test("buttons that do nothing say why", () => {
  assert.deepEqual(texts(seen(held("bob"), { own: "eve" })), ["Request control: a watcher may not drive"]);
  assert.deepEqual(texts(seen(held("anna"), { online: false })), ["Release: the vehicle is offline"]);
  assert.deepEqual(texts(seen({ state: "lost", holder: "anna" })), ["Take control: the vehicle receives nothing from this station"]);
  assert.deepEqual(texts(seen(held("anna"), { page: "unknown" })), ["Take control: no connection to the station"]);
});

test("another page of the station is asked for a confirmation, one that has closed is not", () => {
  assert.deepEqual(choicesOf(seen(held("anna"), { page: "another" })), [{ text: "Take control", from: "page" }]);
  assert.deepEqual(choicesOf(seen(held("anna"), { page: "nobody", online: false })), [{ text: "Take control" }]);
});

test("everybody is told who asks and to whom control is offered", () => {
  const table = [
    [held("bob"), ""],
    [held("bob", { requested: ["anna"] }), "You ask for control"],
    [held("anna", { requested: ["bob", "carol"] }), "bob, carol ask for control"],
    [held("anna", { offered: "bob", requested: ["bob", "carol"] }), "You offer control to bob; you drive until bob accepts. carol asks for control"],
    [held("bob", { offered: "carol" }), "bob offers control to carol"],
  ];
  for (const [driving, words] of table) assert.equal(handOverWords(seen(driving)), words);
  const closed = { absentAt: "12:03" };
  assert.equal(handOverWords(seen(held("anna"), closed)), "");
  const asked = handOverWords(seen(held("bob", { requested: ["anna"] }), closed));
  assert.equal(asked, "bob's page has been closed since 12:03: nobody answers there. You ask for control");
  const view = seen(held("bob", { offered: "anna", requested: ["anna"] }), { unseen: ["rear"] });
  assert.equal(handOverWords(view), "bob offers control to you; not live for 1 s yet: rear");
});

test("whoever drives, or a supervisor, lifts a stop that somebody has asked for", () => {
  const stop = { stop: "eve", stop_since: 5 };
  assert.deepEqual(texts(seen(held("anna", stop))), ["Release", "Offer …", "Lift stop"]);
  assert.deepEqual(texts(seen(held("bob", stop))), ["Request control"]);
  assert.deepEqual(texts(seen(held("bob", { ...stop, present: { ...PRESENT, anna: "supervisor" } }))), ["Request control", "Take control", "Lift stop"]);
  assert.deepEqual(texts(seen(stop)), ["Take control"], "then it can be lifted");
  assert.equal(stopWords(seen({ ...stop, standing: false }).driving, "anna", "14:03"), "eve asked to stop at 14:03: advised speed 0, it still moves");
  assert.equal(stopWords(seen(stop).driving, "eve"), "You asked to stop: advised speed 0, it stands");
  assert.equal(stopWords(seen().driving, "eve"), "");
});

test("a picture counts once it has been live for a second without a break", () => {
  const pictures = new LivePictures();
  pictures.update({ front: "live", rear: "lost" }, 0);
  assert.deepEqual(pictures.seen(999), []);
  assert.deepEqual(pictures.seen(1000), ["front"]);
  pictures.update({ front: "late", rear: "live" }, 1100);
  pictures.update({ front: "live", rear: "live" }, 1200);
  assert.deepEqual([pictures.seen(2100), pictures.seen(2200)], [["rear"], ["rear", "front"]]);
});
