/** Detects button presses of gamepads and wheels. Pure. */

const END = 0.5; // an axis that is further from its middle counts as pressed,
const RELEASED = 0.3; // and as released at this distance
// Of a cross reported as one axis, from -1 to 1; null: between two.
const DIRECTIONS = ["up", null, "right", null, "down", null, "left", null];
const TOLERANCE = 0.1; // of a step between directions

/** @typedef {{index: number, buttons: readonly {pressed: boolean}[], axes?: readonly number[]}} Pad as the Gamepad API reports it */

/**
 * What is held: numbers of buttons, and names of axes: axis6-, axis6+, hat9-left.
 * @param {Pad} pad
 * @param {Set<number|string>} [before] what was held at the last poll
 * @returns {(number|string)[]}
 */
function heldOf({ buttons, axes = [] }, before) {
  const numbers = buttons.flatMap(({ pressed }, i) => (pressed ? [i] : []));
  const ends = axes.map((value, i) => ({ name: `axis${i}${value < 0 ? "-" : "+"}`, far: Math.abs(value) }));
  const pressed = ends.filter(({ name, far }) => far <= 1 && far > (before?.has(name) ? RELEASED : END)).map(({ name }) => name);
  return [...numbers, ...pressed, ...axes.flatMap((value, i) => directionOf(value).map((direction) => `hat${i}-${direction}`))];
}

/**
 * The direction if an axis reports that of a cross, which is beyond 1 while nothing is pressed.
 * @param {number} value  @returns {string[]}
 */
function directionOf(value) {
  const step = ((value + 1) * (DIRECTIONS.length - 1)) / 2;
  const direction = Math.abs(step - Math.round(step)) <= TOLERANCE ? DIRECTIONS[Math.round(step)] : null;
  return direction ? [direction] : [];
}

export class Presses {
  /** @type {Map<number, Set<number|string>>} by pad, the buttons held at the last poll */
  held = new Map();

  /**
   * The buttons pressed since the last poll, each once. A button that is held when a pad connects counts only after it was
   * released.
   * @param {Pad[]} pads all connected pads
   * @returns {(number|string)[]}
   */
  poll(pads) {
    const before = this.held;
    this.held = new Map(pads.map((pad) => [pad.index, new Set(heldOf(pad, before.get(pad.index)))]));
    const isNew = (index, button) => before.has(index) && !before.get(index)?.has(button);
    const pressed = [...this.held].flatMap(([index, held]) => [...held].filter((button) => isNew(index, button)));
    return [...new Set(pressed)];
  }

  /** Ignore buttons that are held at the next poll: browsers report no changes while the page is out of focus. */
  reset() {
    this.held = new Map();
  }
}

/**
 * The action of a key or button.
 * @template T
 * @param {Record<string, T|null>} inputs by action
 * @param {T} value
 */
export const actionOf = (inputs, value) => Object.keys(inputs).find((action) => inputs[action] === value);

/**
 * The name of a key, whether or not Caps Lock is on.
 * @param {{key: string, shiftKey: boolean}} event
 */
export function keyOf({ key, shiftKey }) {
  const isLetter = key.length === 1 && key.toLowerCase() !== key.toUpperCase();
  return !isLetter ? key : shiftKey ? key.toUpperCase() : key.toLowerCase();
}
