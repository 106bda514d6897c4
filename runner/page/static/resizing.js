/**
 * Sizes of canvases in the worker. Without a GPU, the first drawing in a canvas of a new size waits in Chromium for the page's
 * main thread. So a canvas gets a new size only when that thread has just answered; until then, it keeps the old one.
 */

let isReady = false; // whether the main thread has just answered, so that waiting for it is short
let isAsked = false; // whether it has not answered yet

/**
 * @param {{width: number, height: number}} canvas  @param {import("./framing.js").Size} size px
 * @returns {boolean} whether it has this size now
 */
export function resize(canvas, { width, height }) {
  if (canvas.width === width && canvas.height === height) return true; // setting the same size has the same effect as a new one
  if (isReady) Object.assign(canvas, { width, height });
  else askPage();
  return isReady;
}

/** Ask the page's main thread for a sign of life. */
export function askPage() {
  if (!isAsked) postMessage({ kind: "asked" });
  isAsked = true;
}

/** The page's main thread has answered. @param {() => void} draw what waits for new sizes */
export function onPageReady(draw) {
  isAsked = false;
  isReady = true;
  try {
    draw();
  } finally {
    isReady = false;
  }
}
