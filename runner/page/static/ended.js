/** How the program that serves a page says that it ends in order; a crash or a cut link says nothing. Pure. */

const ENDED = "the station has ended"; // as runner/page/connections.py closes its WebSockets

/** @param {{reason: string}} close of a WebSocket */
export const hasEnded = ({ reason }) => reason === ENDED;
