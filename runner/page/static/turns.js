/**
 * Which picture is drawn next when there is no time to draw all: the front camera's first, then that of the camera that has
 * waited longest. Pure; ms.
 */

const BUDGET_MS = 12; // of an animation frame, which has 16 at 60 Hz

/**
 * Draw waiting pictures: the first camera's, one other, and more while there is time.
 * @template {{name: string, isWaiting: boolean, last_drawn: number, draw: () => void}} Drawn
 * @param {Drawn[]} streams
 * @param {string|null} first camera whose picture never waits for others
 * @param {() => number} clock
 * @returns {boolean} whether pictures still wait
 */
export function drawInTurn(streams, first, clock) {
  const began = clock();
  const waiting = streams.filter((stream) => stream.isWaiting);
  const others = waiting.filter(({ name }) => name !== first).sort((a, b) => a.last_drawn - b.last_drawn);
  waiting.find(({ name }) => name === first)?.draw();
  for (const [count, stream] of others.entries()) {
    if (count > 0 && clock() - began >= BUDGET_MS) return true;
    stream.draw();
  }
  return false;
}
