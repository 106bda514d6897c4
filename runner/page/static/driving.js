/**
 * Who drives from one page's point of view, and what its person may do about it: what the vehicle publishes about its
 * operators, together with which page of the station acts for this one. Pure.
 */

/**
 * @typedef {import("./records.js").Driving} Driving
 *
 * @typedef {"you"|"another"|"nobody"|"operator"|"lost"|"unheard"|"free"|"unknown"} Who drives
 *   you, another, nobody: this station's operator, by this page, another page or none of its pages
 *   operator: another operator; lost: another one, whom the vehicle no longer hears
 *   unheard: the vehicle does not hear this station; free: nobody; unknown: the vehicle is offline
 *
 * @typedef {object} View of the page on who drives
 * @property {Driving|null} driving as the vehicle last published it; null: not yet
 * @property {string} own this station's operator
 * @property {string} page which of the station's pages acts for it: you, another or nobody; unknown: there is no connection
 * @property {boolean} [online] whether the vehicle is
 * @property {string[]} [unseen] cameras that are sent but have not been live here for long enough
 * @property {string} [absentAt] time of day at which the page of the operator in control was closed; "": it is open
 *
 * @typedef {object} Choice
 * @property {string} text of the button
 * @property {string|null} [why] it cannot be pressed now
 * @property {boolean} [isAnswer] whether it answers what an operator has asked or offered
 * @property {string} [hint] what it does, in more words
 * @property {"page"|"operator"} [from] from whom control is taken without asking; its person has to confirm
 * @property {string[]} [takers] operators to choose from
 * @property {Record<string, any>} [event] to request of the vehicle; without one, this page is to act for its station
 */

const DRIVERS = ["controller", "supervisor"];

/** @param {View} view @returns {Who} */
export function whoDrives({ driving, own, page }) {
  if (!driving || page === "unknown") return "unknown";
  const { state, holder, present } = driving;
  if (state === "free") return own in present ? "free" : "unheard";
  if (holder !== own) return state === "lost" ? "lost" : "operator";
  return state === "lost" ? "unheard" : /** @type {Who} */ (page);
}

/** Who drives, in words. @param {Who} who  @param {Driving|null} driving */
export const driverWords = (who, driving) =>
  ({
    you: "You are in control",
    another: "Another page is in control",
    nobody: "No open page is in control",
    operator: `Operator ${driving?.holder} is in control`,
    lost: `Operator ${driving?.holder} is lost`,
    unheard: "Vehicle does not receive you",
    free: "Nobody is in control",
    unknown: "",
  })[who];

/**
 * Who has asked the vehicle to stop, in words; "": nobody.
 * @param {Driving|null} driving  @param {string} own  @param {string} [at] time of day
 */
export function stopWords(driving, own, at) {
  if (!driving?.stop) return "";
  const still = driving.standing ? "it stands" : "it still moves";
  return `${driving.stop === own ? "You" : driving.stop} asked to stop${at ? ` at ${at}` : ""}: advised speed 0, ${still}`;
}

/** That nobody sees the pictures of another operator who is in control, in words; "": somebody does. @param {View} view */
function absentWords({ driving, own, absentAt }) {
  if (!absentAt || driving?.state !== "held" || driving.holder === own) return "";
  return `${driving.holder}'s page has been closed since ${absentAt}: nobody answers there`;
}

/**
 * What operators have asked or offered, in words; "": nothing. Those that only watch are told, too.
 * @param {View} view
 */
export function handOverWords(view) {
  return [absentWords(view), askedWords(view)].filter(Boolean).join(". ");
}

/** @param {View} view */
function askedWords({ driving, own, unseen = [] }) {
  if (!driving) return "";
  const named = (name) => (name === own ? "you" : name);
  const { holder, offered } = driving;
  const asking = driving.requested.filter((name) => name !== offered).map(named);
  const isOne = asking.length === 1 && asking[0] !== "you";
  const asks = asking.length ? `${asking.join(", ")} ${isOne ? "asks" : "ask"} for control` : "";
  if (!offered) return sentence(asks);
  const wait = offered === own && unseen.length ? waiting(unseen) : "";
  const until = holder === own ? `you drive until ${offered} accepts` : wait;
  const offers = [`${named(holder)} ${holder === own ? "offer" : "offers"} control to ${named(offered)}`, until];
  return [offers.filter(Boolean).join("; "), asks].filter(Boolean).map(sentence).join(". ");
}

/**
 * What has come to nothing since, in words; "": nothing.
 * @param {Driving|null} before  @param {Driving|null} now  @param {string} own
 */
export function endedWords(before, now, own) {
  if (!before || now?.state !== "held" || before.holder !== now.holder) return "";
  const drives = now.holder === own ? "you drive" : `${now.holder} drives`;
  if (before.offered && !now.offered) {
    if (now.holder === own) return `${before.offered} has not taken control: ${drives}`;
    if (before.offered === own) return `The offer of control has ended: ${drives}`;
  }
  const asked = before.requested.includes(own) && !now.requested.includes(own) && now.offered !== own;
  return asked ? `Your request for control has ended: ${drives}` : "";
}

const sentence = (text) => text.replace(/^you/, "You"); // an operator's name is left as it is
const waiting = (unseen) => `not live for 1 s yet: ${unseen.join(", ")}`;

/** At what speed the vehicle goes, in words. @param {number|null|undefined} speed_mps */
export const speedWords = (speed_mps) =>
  Number.isFinite(speed_mps) ? `at ${Math.round(3.6 * (speed_mps ?? 0))} km/h` : "at a speed that is not known, which counts as moving";

/**
 * The buttons about control, and about a stop that somebody has asked for; the first one is also the key's.
 * @param {View} view
 * @returns {Choice[]}
 */
export const choicesOf = (view) => [...aboutControl(view), ...(mayLift(view) ? [LIFT] : [])];

const LIFT = { text: "Lift stop", isAnswer: true, event: { event: "stop_lifted" } };

/** @param {View} view */
function mayLift(view) {
  const { driving, own, online } = view;
  return Boolean(online && driving?.stop) && (whoDrives(view) === "you" || driving?.present[own] === "supervisor");
}

/** @param {View} view @returns {Choice[]} */
function aboutControl(view) {
  const { driving, own, page, online } = view;
  const who = whoDrives(view);
  if (page === "unknown") return [{ text: "Take control", why: "no connection to the station" }];
  if (page === "another" && ["another", "unknown"].includes(who)) return [{ text: "Take control", from: "page" }];
  if (page === "nobody" && ["nobody", "unknown"].includes(who)) return [{ text: "Take control" }];
  if (!online) return [{ text: who === "you" ? "Release" : "Take control", why: "the vehicle is offline" }];
  if (who === "unheard") return [{ text: "Take control", why: "the vehicle receives nothing from this station" }];
  const role = driving?.present[own];
  if (role && !DRIVERS.includes(role)) return [{ text: "Request control", why: `a ${role} may not drive` }];
  if (who === "you") return whileDriving(view);
  if (who === "free") return [{ text: "Take control", event: { event: "control_requested" } }];
  return driving?.offered === own ? whenOffered(view) : whileWatching(view);
}

const RELEASED = { event: "control_released" };
const offerTo = (name) => ({ text: `Offer control to ${name}`, isAnswer: true, event: { event: "control_offered", to: name } });
const decline = (name) => ({ text: `Decline ${name}`, isAnswer: true, event: { event: "control_denied", to: name } });

/** @param {View} view @returns {Choice[]} */
function whileDriving({ driving, own }) {
  const release = { text: "Release", event: RELEASED };
  if (driving?.offered) return [{ text: "Withdraw offer", isAnswer: true, event: { event: "control_offered", to: "" } }, release];
  const able = Object.entries(driving?.present ?? {}).filter(([name, role]) => name !== own && DRIVERS.includes(role));
  const asking = driving?.requested ?? [];
  const takers = able.map(([name]) => name).filter((name) => !asking.includes(name)).sort();
  return [...asking.flatMap((name) => [offerTo(name), decline(name)]), release, ...(takers.length ? [{ text: "Offer …", takers }] : [])];
}

/** @param {View} view @returns {Choice[]} */
function whenOffered({ driving, unseen = [] }) {
  const why = unseen.length ? waiting(unseen) : null;
  const [isAnswer, event] = [true, { event: "control_accepted" }];
  const blind = why && driving?.standing ? [{ text: "Accept without pictures", isAnswer, event }] : [];
  return [{ text: "Accept control", isAnswer, why, event }, ...blind, { text: "Decline", isAnswer, event: RELEASED }];
}

/** @param {View} view @returns {Choice[]} */
function whileWatching({ driving, own }) {
  const asks = driving?.requested.includes(own);
  /** @type {Choice} */
  let ask = { text: "Request control", event: { event: "control_requested" } };
  if (asks) ask = { text: "Withdraw request", isAnswer: true, event: RELEASED };
  if (driving?.present[own] !== "supervisor") return [ask];
  const hint = "take control without asking, as a supervisor; the next window asks whether you are sure";
  return [ask, { text: "Take control", hint, from: "operator", event: { event: "control_taken" } }];
}

const LIVE_MS = 1000; // a picture has to be live for this long before its driver takes over

/** Since when the pictures are live. */
export class LivePictures {
  /** @type {Map<string, number>} */
  #since = new Map();

  /** To be called with each change. @param {Record<string, string>} status by camera  @param {number} now ms */
  update(status, now) {
    for (const [name, each] of Object.entries(status)) {
      if (each !== "live") this.#since.delete(name);
      else if (!this.#since.has(name)) this.#since.set(name, now);
    }
  }

  /** The cameras that have been live long enough. @param {number} now */
  seen(now) {
    return [...this.#since].filter(([, since]) => now - since >= LIVE_MS).map(([name]) => name);
  }
}
