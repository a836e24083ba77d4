/** Live updates: follows the event stream and replaces the content of the page after a change. */

const AGAIN = 2000;
const state = document.getElementById("state");
const words = document.getElementById("state-text");
let token = document.body.dataset.token;
let stream = null;
let newest = null;
let busy = false;

/** Show the progress of the grid in the header. @param {object} progress the server's read_progress */
function say(progress) {
  const writing = progress.launches_running > 0 && progress.ended < progress.total;
  state.dataset.mode = writing ? "writing" : "still";
  const counts = `${progress.ended.toLocaleString("en")} of ${progress.total.toLocaleString("en")}`;
  const failed = progress.counts.failed ? `, ${progress.counts.failed} failed` : "";
  const text = progress.total ? `${counts} trials ended${failed}` : "no trials yet";
  if (words.textContent !== text) words.textContent = text;
  state.title = writing ? "A launch is running; this page updates itself." : "No launch is running.";
}

/** Show that there is no news. @param {string} text */
function lose(text) {
  state.dataset.mode = "lost";
  state.title = "";
  words.textContent = text;
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

/** Show the progress, and update the page if a trial has changed. */
async function show(progress) {
  if ("retry" in document.body.dataset) location.reload();
  say(progress);
  const changed = token && token !== progress.token;
  ({ token } = progress);
  if (changed) {
    await refresh();
    document.dispatchEvent(new CustomEvent("dopt:change"));
  }
}

/** Take an event; of those that come during an update, only the last counts. @param {MessageEvent} event */
async function take(event) {
  newest = JSON.parse(event.data);
  if (busy) return;
  busy = true;
  try {
    while (newest) {
      const progress = newest;
      newest = null;
      await show(progress);
    }
  } catch {
    lose("server not reachable");
  } finally {
    busy = false;
  }
}

/** Follow the stream while the page is visible: a browser has few connections for all its tabs. */
function follow() {
  stream?.close();
  stream = null;
  if (document.hidden) return;
  stream = new EventSource("/api/events");
  stream.addEventListener("progress", take);
  stream.addEventListener("unavailable", () => lose("database not available"));
  stream.addEventListener("error", () => {
    lose("server not reachable"); // the browser connects again, unless the server has refused
    if (stream?.readyState === EventSource.CLOSED) setTimeout(follow, AGAIN);
  });
}

document.addEventListener("visibilitychange", follow);
addEventListener("pagehide", () => stream?.close());
addEventListener("pageshow", ({ persisted }) => persisted && follow());
follow();
