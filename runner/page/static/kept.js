/** Mode S begins with what the mode before has given: whether a camera still has that, or what was set since. Pure. */

const NAMES = { automatic: "A", collective: "C" };

export class Kept {
  /** @type {string|null} */
  #mode = null; // last known
  #before = ""; // the mode that S followed; "": unknown, as on a page that was opened in S
  /** @type {Record<string, {kbps: number, scaling: number|null}>} */
  #given = {};

  /** @param {{mode: string, cameras: Record<string, {kbps: number, scaling: number|null}>}} state of the vehicle */
  update({ mode, cameras }) {
    if (mode === "single" && this.#mode !== "single") {
      this.#before = NAMES[this.#mode ?? ""] ?? "";
      this.#given = cameras;
    }
    this.#mode = mode;
  }

  /** Where the settings of a camera in mode S come from. @param {string} name  @param {{kbps: number, scaling: number|null}} now */
  words(name, now) {
    if (!this.#before) return "Set here, or kept from the mode before S.";
    const given = this.#given[name];
    const isKept = given?.kbps === now.kbps && given.scaling === now.scaling;
    return isKept ? `Kept from mode ${this.#before}: set it here.` : "Set in mode S.";
  }
}
