/** Live updates: polls the progress and replaces the content of the page after a change. */

const PERIOD = 2000;
const state = document.getElementById("state");
const words = document.getElementById("state-text");
let token = document.body.dataset.token;

/**
 * @typedef {object} Progress
 * @property {string} token changes whenever a trial does
 * @property {Object<string, number>} counts trials by status
 * @property {number} total
 * @property {number} ended
 * @property {number} running
 * @property {number} launches_running
 */

/** Show the progress of the grid in the header. @param {Progress} progress */
function say(progress) {
  const writing = progress.launches_running > 0 && progress.ended < progress.total;
  state.dataset.mode = writing ? "writing" : "still";
  const counts = `${progress.ended.toLocaleString("en")} of ${progress.total.toLocaleString("en")}`;
  const failed = progress.counts.failed ? `, ${progress.counts.failed} failed` : "";
  const text = progress.total ? `${counts} trials ended${failed}` : "no trials yet";
  if (words.textContent !== text) words.textContent = text;
  state.title = writing ? "A launch is running; this page updates itself." : "No launch is running.";
}

/** Replace the parts of the page that show data by their new content. */
async function refresh() {
  const parts = document.querySelectorAll("[data-live]");
  if (!parts.length) return;
  const answer = await fetch(location.href, { headers: { accept: "text/html" } });
  if (!answer.ok) return;
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
  for (const part of parts) {
    const next = fresh.getElementById(part.id);
    if (!next) {
      location.reload(); // a pending trial has ended: its page now has charts
      return;
    }
    if (next.innerHTML === part.innerHTML) continue;
    const focused = part.contains(document.activeElement) && document.activeElement;
    const href = focused && focused.getAttribute("href");
    part.replaceChildren(...next.childNodes);
    if (href) part.querySelector(`[href="${CSS.escape(href)}"]`)?.focus();
  }
}

/** Fetch the progress once; update the page after a change. */
async function poll() {
  try {
    const answer = await fetch("/api/progress", { signal: AbortSignal.timeout(10_000) });
    if (!answer.ok) throw new Error(String(answer.status));
    /** @type {Progress} */
    const progress = await answer.json();
    if ("retry" in document.body.dataset) location.reload();
    say(progress);
    const changed = token && token !== progress.token;
    token = progress.token;
    if (changed) {
      await refresh();
      document.dispatchEvent(new CustomEvent("dopt:change"));
    }
  } catch {
    state.dataset.mode = "lost";
    words.textContent = "server not reachable";
  }
}

/** Poll while the page is visible. */
async function follow() {
  if (!document.hidden) await poll();
  setTimeout(follow, PERIOD);
}

document.addEventListener("visibilitychange", () => !document.hidden && poll());
follow();
