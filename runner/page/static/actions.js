/** The operator's actions; `inputs` in the configuration assigns them to keys and buttons. */

import { camera, enlarge, inControl, publish, select, store } from "./store.js";
import { selectMode } from "./header.js";
import { toggleControl } from "./control.js";
import { askToStop } from "./stopping.js";
import { driveRoles, focusTile, switchCamera } from "./tiles.js";
import { scaleTotal } from "./total.js";
import { sendFull } from "./panel.js";
import { toggleTheme } from "./theme.js";
import { cycleBirdseye } from "./birdseye.js";
import { toggleGuides } from "./drive.js";
import { toggleStraight } from "./straighten.js";
import { toggleSound } from "./sound.js";
import { toggleHearing } from "./hearing_page.js";
import { hold } from "./talking_page.js";
import { toggleDrawer, toggleFullScreen, toggleTab, toggleView } from "./views.js";
import { listMonitors } from "./monitors.js";
import { request, showProblem, whyNoControl } from "./requests.js";
import { isEditing } from "./edit.js";

/**
 * @typedef {object} Action
 * @property {string} description
 * @property {() => unknown} run
 * @property {boolean} [onCameras] a key triggers it only while no control has the focus: Enter on a button presses the button
 */
/** @type {[string, Action][]} */
const BY_NUMBER = Array.from({ length: 9 }, (_, i) => i + 1).map((number) =>
  [`camera_${number}`, { description: `select camera ${number}`, run: () => selectNumber(number) }]);

/** @type {Record<string, Action>} */
export const ACTIONS = {
  camera_left: { description: "select the left camera", run: () => selectRole("left"), onCameras: true },
  camera_front: { description: "select the front camera", run: () => selectRole("front"), onCameras: true },
  camera_right: { description: "select the right camera", run: () => selectRole("right"), onCameras: true },
  camera_rear: { description: "select the rear camera", run: () => selectRole("rear"), onCameras: true },
  ...Object.fromEntries(BY_NUMBER),
  reverse: { description: "Drive view: swap the rear and front cameras; press again to undo", run: reverse },
  enlarge: {
    description: "enlarge the selected camera (double click); in the Drive view it changes places with the front camera",
    run: enlargeSelected,
    onCameras: true,
  },
  back: { description: "back from the enlarged picture", run: () => store.enlarged && enlarge(null) },
  mode_single: { description: "mode Single", run: () => selectMode("single") },
  mode_automatic: { description: "mode Automatic", run: () => selectMode("automatic") },
  mode_collective: { description: "mode Collective", run: () => selectMode("collective") },
  total_lower: { description: "mode Collective: lower the total by a tenth", run: () => scaleTotal(0.9) },
  total_raise: { description: "mode Collective: raise the total by a tenth", run: () => scaleTotal(1.1) },
  view: { description: "Drive or Configure view", run: toggleView },
  guides: {
    description: "Drive view: lines on the ground of calibrated cameras, of all, or none",
    run: () => store.view !== "configure" && toggleGuides(),
  },
  birdseye: {
    description: "Drive view: bird's-eye view in place of the top views, large in place of the front camera, or none",
    run: cycleBirdseye,
  },
  straighten: { description: "straighten the picture of the selected fisheye, or show the original", run: () => toggleStraight() },
  drawer: { description: "Drive view: open or close the drawer", run: toggleDrawer },
  map: { description: "the map; in the Drive view opens or closes the drawer with it", run: () => toggleTab("map") },
  sound: { description: "alarm tones on or off", run: toggleSound },
  hear: { description: "the vehicle's sound on or off", run: toggleHearing },
  talk: { description: "speak at the vehicle while it is held", run: () => hold("key") },
  full_screen: { description: "full screen", run: toggleFullScreen },
  monitors: { description: "pictures in additional windows, for other monitors", run: listMonitors },
  switch: { description: "switch the selected camera on or off", run: () => store.selected && switchCamera(store.selected) },
  keep: { description: "keep the last 60 s: mark them, and protect the drive that is logged", run: keepMoment },
  full_image: { description: "full image of the selected camera, or of all", run: sendFull },
  control: { description: "take, request, offer, accept or release control: the first of its buttons", run: toggleControl },
  stop: { description: "ask the vehicle to stop; whoever drives, or a supervisor, lifts it by a button", run: askToStop },
  theme: { description: "night or day theme", run: toggleTheme },
  help: { description: "show this list", run: () => publish("help") },
};

// Only the page shows what these change, so a monitor passes them on to it.
const OF_PAGE = ["camera_left", "camera_front", "camera_right", "camera_rear", "reverse", "view", "birdseye", "drawer",
  "map", "monitors", "sound", "hear", "full_image", "total_lower", "total_raise", "keep"];
const channel = new BroadcastChannel(`tod-actions ${location.pathname}`);

const KEPT_S = 60;

function keepMoment() {
  request("keep", { event: "moment_marked", back_s: KEPT_S }, `keep the last ${KEPT_S} s`);
}

export function startActions() {
  for (const name of OF_PAGE) passOn(name, () => false);
  passOn("back", () => store.enlarged !== null || !inControl());
  passOn("enlarge", () => camera(store.selected) !== undefined);
  passOn("straighten", () => camera(store.selected) !== undefined);
  channel.onmessage = ({ data }) =>
    store.view !== "monitor" && inControl() && (typeof data === "number" ? selectNumber(data) : ACTIONS[data]?.run());
}

/**
 * Have a monitor pass an action on to its page, unless it concerns the monitor itself.
 * @param {string} name  @param {() => boolean} isOwn
 */
function passOn(name, isOwn) {
  const { run } = ACTIONS[name];
  ACTIONS[name].run = () => (store.view !== "monitor" || isOwn() ? run() : tellPage(name));
}

/** @param {string|number} message name of an action, or the number of a camera */
const tellPage = (message) => (inControl() ? channel.postMessage(message) : showProblem(whyNoControl()));

/**
 * Select a camera by its number among the vehicle's, from 1 on; a monitor has its page select one that it does not show.
 * @param {number} number
 */
export function selectNumber(number) {
  const found = store.hello?.cameras.find(({ index }) => index === number - 1);
  if (found || store.view !== "monitor") selectCamera(found?.name);
  else tellPage(number);
}

/** @param {"left"|"front"|"right"|"rear"} role */
function selectRole(role) {
  selectCamera(driveRoles()[role]?.name);
}

/** Switch between driving forwards and backwards. */
function reverse() {
  const { front, rear } = driveRoles();
  if (store.view !== "drive") return;
  if (!rear) return publish("toast", { text: "no camera looks backwards", level: "hint" });
  const large = store.enlarged === rear.name;
  enlarge(large ? null : rear.name);
  selectCamera((large ? front : rear)?.name);
}

function enlargeSelected() {
  if (store.selected && !isEditing()) enlarge(store.enlarged === store.selected ? null : store.selected);
}

/** In the Drive view a driver who looks aside keeps the large picture; elsewhere the enlarged one changes. */
export function selectCamera(name) {
  if (name === undefined) return;
  if (store.enlarged && store.view !== "drive") enlarge(name);
  select(name);
  focusTile(name);
}
