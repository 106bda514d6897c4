/** The login page. It answers the server's challenge, so that the token never leaves this browser. */

const form = /** @type {HTMLFormElement} */ (document.getElementById("login"));
const field = /** @type {HTMLInputElement} */ (document.getElementById("token"));
const problem = /** @type {HTMLElement} */ (document.getElementById("problem"));

/**
 * HMAC-SHA256, hexadecimal.
 * @param {string} token
 * @param {string} challenge
 */
async function answerTo(token, challenge) {
  const text = new TextEncoder();
  const algorithm = { name: "HMAC", hash: "SHA-256" };
  const key = await crypto.subtle.importKey("raw", text.encode(token), algorithm, false, ["sign"]);
  const digest = new Uint8Array(await crypto.subtle.sign("HMAC", key, text.encode(challenge)));
  return Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

async function logIn() {
  const response = await fetch("/login/challenge", { method: "POST" });
  const { challenge } = await response.json();
  const answer = await answerTo(field.value.trim(), challenge);
  const result = await fetch("/login", { method: "POST", body: JSON.stringify({ challenge, answer }) });
  if (result.ok) location.assign(`/${location.search}${location.hash}`);
  else problem.textContent = result.status === 403 ? "Wrong token." : `Login failed: ${await result.text()}`;
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  problem.textContent = "";
  logIn().catch((error) => { problem.textContent = `Login failed: ${error.message}`; });
});
