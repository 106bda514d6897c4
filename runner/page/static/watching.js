/** Who only watches: this page's visitor, or others beside it. */

import { listen, onlyWatches, store } from "./store.js";
import { byId, setAttribute, setText } from "./format.js";

function refresh() {
  const [isWatcher, names] = [onlyWatches(), store.connected ? store.watching : []];
  setAttribute(document.body, "data-watches", isWatcher ? "" : null);
  byId("watching").hidden = !isWatcher && !names.length;
  setText(byId("watching"), isWatcher ? `Watching as ${store.hello?.visitor.name}` : `${names.length} watching`);
  byId("watching").title = isWatcher ? "This page can request nothing" : names.join(", ");
}

export function startWatching() {
  listen("hello control socket", refresh);
}
