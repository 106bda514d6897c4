/** Buttons of gamepads and wheels, by the browser's Gamepad API, which states what is held: it has to be asked. */

import { listen, note, publish, store } from "./store.js";
import { ACTIONS } from "./actions.js";
import { actionOf, Presses } from "./presses.js";

const LOOK_MS = 15;
const EFFECTS = {
  lost: { duration: 600, strongMagnitude: 1, weakMagnitude: 1 },
  late: { duration: 200, strongMagnitude: 0.3, weakMagnitude: 0.6 },
};

const presses = new Presses();
/** @type {ReturnType<typeof setInterval>|undefined} while there is a pad */
let looking;

const pads = () => navigator.getGamepads().flatMap((pad) => (pad?.connected ? [pad] : []));
const nameOf = ({ id }) => id.replace(/\s*\(.*/, "") || "gamepad";

function look() {
  if (!document.hasFocus()) return presses.forget(); // browsers report no change meanwhile
  for (const button of presses.look(pads())) {
    const action = ACTIONS[actionOf(store.hello?.inputs.buttons ?? {}, button) ?? ""];
    if (!document.querySelector("dialog[open]")) action?.run();
  }
}

function came({ gamepad }) {
  publish("toast", { text: `${nameOf(gamepad)} connected`, level: "hint" });
  looking ??= setInterval(look, LOOK_MS);
}

function went({ gamepad }) {
  const text = `${nameOf(gamepad)} is gone: its buttons no longer work`;
  note({ text, level: "problem" });
  publish("toast", { text, level: "problem" });
  if (pads().length) return;
  clearInterval(looking);
  looking = undefined;
}

/** Vibrate for a picture that is lost or late. */
function vibrate(kind) {
  for (const { vibrationActuator } of pads()) Promise.resolve(vibrationActuator?.playEffect("dual-rumble", EFFECTS[kind])).catch(() => {}); // not every device can
}

export function startGamepads() {
  addEventListener("gamepadconnected", came);
  addEventListener("gamepaddisconnected", went);
  listen("alarm", vibrate);
}
