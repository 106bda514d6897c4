/**
 * Loads the page again if a part of it is missing: one request that fails, as on a poor network, leaves the page without
 * its modules. Not part of boot.js, which may be missing itself.
 */
"use strict";

const AGAIN_MS = 1000; // between two attempts
const ANSWERED_MS = 2000; // limit of one: a station that hangs does not end the attempts
let isLoadingAgain = false;

addEventListener("load", () => globalThis.tod ?? loadAgain());

/** Load the page again as soon as the station answers. */
async function loadAgain() {
  if (isLoadingAgain) return;
  isLoadingAgain = true;
  const banner = document.getElementById("banner");
  if (banner) Object.assign(banner, { textContent: "This page did not load completely: loading it again", hidden: false });
  let answers = false;
  while (!answers) {
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    const limited = { cache: /** @type {const} */ ("no-store"), signal: AbortSignal.timeout(ANSWERED_MS) };
    answers = await fetch(location.href, limited).then(({ ok }) => ok, () => false);
  }
  location.reload();
}
