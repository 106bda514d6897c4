/** Buttons of gamepads and wheels, through the browser's Gamepad API, which must be polled. */

import { inControl, listen, publish, remind, store } from "./store.js";
import { ACTIONS } from "./actions.js";
import { withKey } from "./hints.js";
import { actionOf, Presses } from "./presses.js";
import { reportProblem } from "./requests.js";
import { hold, letGo } from "./talking_page.js";

const POLL_MS = 15;
/** @type {Record<string, string[]>} by dialog, the actions whose buttons close it; the list of keys shows which button is pressed */
const CLOSING = { help: ["help"], confirm: ["back", "control"], "offer-to": ["back", "control"], monitors: ["back", "monitors"] };
const EFFECTS = {
  lost: { duration: 600, strongMagnitude: 1, weakMagnitude: 1 },
  late: { duration: 200, strongMagnitude: 0.3, weakMagnitude: 0.6 },
  asked: { duration: 200, strongMagnitude: 0.3, weakMagnitude: 0.6 },
  passed: { duration: 400, strongMagnitude: 0.6, weakMagnitude: 0.6 },
};

const presses = new Presses();
/** @type {ReturnType<typeof setInterval>|undefined} set while a pad is connected */
let pollTimer;

const pads = () => navigator.getGamepads().flatMap((pad) => (pad?.connected ? [pad] : []));
const nameOf = ({ id }) => id.replace(/\s*\(.*/, "") || "gamepad";
const keyOf = ({ id }) => `gamepad ${id}`; // of its reminder

function poll() {
  if (!document.hasFocus()) return presses.reset(); // browsers report no change meanwhile
  const pressed = presses.poll(pads());
  if (pressed.length) publish("pressed", pressed);
  const talk = store.hello?.inputs.buttons.talk;
  if (![...presses.held.values()].some((held) => held.has(talk ?? ""))) letGo("pad");
  for (const button of pressed) {
    const name = actionOf(store.hello?.inputs.buttons ?? {}, button) ?? "";
    const dialog = document.querySelector("dialog[open]");
    if (!dialog) name === "talk" ? hold("pad") : ACTIONS[name]?.run();
    else if ((CLOSING[dialog.id] ?? ["back"]).includes(name)) /** @type {HTMLDialogElement} */ (dialog).close();
  }
}

function onConnected({ gamepad }) {
  const isStandard = gamepad.mapping === "standard";
  const own = "connected: it numbers its buttons in its own order; check inputs.buttons; the list of keys shows what is pressed";
  const text = isStandard ? "connected" : withKey(own, "help");
  publish("toast", { text: `${nameOf(gamepad)} ${text}`, level: isStandard ? "hint" : "problem" });
  remind(keyOf(gamepad), null);
  pollTimer ??= setInterval(poll, POLL_MS);
}

function onDisconnected({ gamepad }) {
  reportProblem(`${nameOf(gamepad)} disconnected: its buttons no longer work`);
  remind(keyOf(gamepad), `GAMEPAD DISCONNECTED ${nameOf(gamepad)}`);
  if (inControl()) publish("unplugged");
  if (pads().length) return;
  clearInterval(pollTimer);
  pollTimer = undefined;
  presses.reset(); // a button held when a pad connects again does not count
}

/** Vibrate with each tone. */
function vibrate(kind) {
  for (const { vibrationActuator } of pads()) {
    Promise.resolve(vibrationActuator?.playEffect("dual-rumble", EFFECTS[kind])).catch(() => {}); // not every device can
  }
}

export function startGamepads() {
  addEventListener("gamepadconnected", onConnected);
  addEventListener("gamepaddisconnected", onDisconnected);
  listen("alarm", vibrate);
}
