/** What the operator does by a key or a button; which one is the vehicle's configuration, `inputs`. */

import { enlarge, publish, select, store } from "./store.js";
import { selectMode, toggleControl } from "./header.js";
import { focusTile, switchCamera } from "./tiles.js";
import { changeTotal } from "./total.js";
import { sendFull } from "./panel.js";
import { toggleTheme } from "./theme.js";
import { rolesOf } from "./arrange.js";
import { changeBirdseye } from "./birdseye.js";
import { toggleGuides } from "./drive.js";
import { toggleStraight } from "./straighten.js";
import { toggleSound } from "./sound.js";
import { toggleDrawer, toggleFullScreen, toggleTab, toggleView } from "./views.js";
import { listMonitors } from "./monitors.js";
import { isEdited } from "./edit.js";

/**
 * @typedef {object} Action
 * @property {string} words
 * @property {() => unknown} run
 * @property {boolean} [onCameras] by a key only while no control has the focus: Enter on a button presses that
 */
/** @type {Record<string, Action>} */
export const ACTIONS = {
  camera_left: { words: "Drive view: select the left camera", run: () => look("left"), onCameras: true },
  camera_front: { words: "Drive view: select the front camera", run: () => look("front"), onCameras: true },
  camera_right: { words: "Drive view: select the right camera", run: () => look("right"), onCameras: true },
  camera_rear: { words: "Drive view: select the rear camera", run: () => look("rear"), onCameras: true },
  reverse: { words: "Drive view: the rear camera large, in the front camera's place, and back", run: reverse },
  enlarge: { words: "enlarge the selected camera (double click); in the Drive view it changes places with the front camera", run: enlargeSelected, onCameras: true },
  back: { words: "back from the enlarged picture", run: () => store.enlarged && enlarge(null) },
  mode_single: { words: "mode Single", run: () => selectMode("single") },
  mode_automatic: { words: "mode Automatic", run: () => selectMode("automatic") },
  mode_collective: { words: "mode Collective", run: () => selectMode("collective") },
  total_lower: { words: "mode Collective: lower the total by a tenth", run: () => changeTotal(0.9) },
  total_raise: { words: "mode Collective: raise the total by a tenth", run: () => changeTotal(1.1) },
  view: { words: "Drive or Configure view", run: toggleView },
  guides: { words: "Drive view: lines on the ground of calibrated cameras, of all, or none", run: () => store.view !== "configure" && toggleGuides() },
  birdseye: { words: "Drive view: bird's-eye view in place of the top views, large in place of the front camera, or none", run: changeBirdseye },
  straighten: { words: "straighten the picture of the selected fisheye, or show it as it comes", run: () => toggleStraight() },
  drawer: { words: "Drive view: open or close the drawer", run: toggleDrawer },
  map: { words: "the map; in the Drive view opens or closes the drawer with it", run: () => toggleTab("map") },
  sound: { words: "Drive view: tones for lost, frozen and late pictures, or none", run: toggleSound },
  full_screen: { words: "full screen", run: toggleFullScreen },
  monitors: { words: "pictures in further windows, for other monitors", run: listMonitors },
  switch: { words: "switch the selected camera on or off", run: () => store.selected && switchCamera(store.selected) },
  full_image: { words: "full image of the selected camera (mode S)", run: sendFull },
  control: { words: "take or release control", run: toggleControl },
  theme: { words: "night or day", run: toggleTheme },
  help: { words: "this list", run: () => publish("help") },
};

/** @param {"left"|"front"|"right"|"rear"} role */
function look(role) {
  if (store.view === "drive") selectCamera(rolesOf(store.hello?.cameras ?? [])[role]?.name);
}

/** Change between driving forwards and backwards. */
function reverse() {
  const { front, rear } = rolesOf(store.hello?.cameras ?? []);
  if (store.view !== "drive") return;
  if (!rear) return publish("toast", { text: "no camera looks back", level: "hint" });
  const large = store.enlarged === rear.name;
  enlarge(large ? null : rear.name);
  selectCamera((large ? front : rear)?.name);
}

function enlargeSelected() {
  if (store.selected && !isEdited()) enlarge(store.enlarged === store.selected ? null : store.selected);
}

export function selectCamera(name) {
  if (name === undefined) return;
  if (store.enlarged) enlarge(name);
  select(name);
  focusTile(name);
}
