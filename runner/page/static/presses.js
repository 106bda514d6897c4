/** Detects button presses of gamepads and wheels. Pure. */

/** @typedef {{index: number, buttons: readonly {pressed: boolean}[]}} Pad as the Gamepad API reports it */

export class Presses {
  /** @type {Map<number, Set<number>>} by pad, the buttons held at the last poll */
  held = new Map();

  /**
   * The buttons pressed since the last poll, each once. A button that is held when a pad connects counts only after it was
   * released.
   * @param {Pad[]} pads all connected pads
   * @returns {number[]}
   */
  poll(pads) {
    const before = this.held;
    this.held = new Map(pads.map(({ index, buttons }) => [index, new Set(buttons.flatMap(({ pressed }, i) => (pressed ? [i] : [])))]));
    const pressed = [...this.held].flatMap(([index, held]) => [...held].filter((button) => before.has(index) && !before.get(index)?.has(button)));
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
