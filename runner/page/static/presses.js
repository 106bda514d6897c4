/** Which buttons of gamepads and wheels were just pressed. Pure. */

/** @typedef {{index: number, buttons: readonly {pressed: boolean}[]}} Pad as the browser states it */

export class Presses {
  /** @type {Map<number, Set<number>>} by pad, the buttons that are held */
  held = new Map();

  /**
   * The buttons that are pressed and were not at the last look, each once. What is held when a pad comes counts after it
   * was released.
   * @param {Pad[]} pads all that are there
   * @returns {number[]}
   */
  look(pads) {
    const before = this.held;
    this.held = new Map(pads.map(({ index, buttons }) => [index, new Set(buttons.flatMap(({ pressed }, i) => (pressed ? [i] : [])))]));
    const pressed = [...this.held].flatMap(([index, held]) => [...held].filter((button) => before.has(index) && !before.get(index)?.has(button)));
    return [...new Set(pressed)];
  }

  /** Count nothing that is held at the next look: the page was out of focus, and browsers reported no change meanwhile. */
  forget() {
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
