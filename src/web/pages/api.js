// Requests to the program.

/** Interval between requests for a result that is being computed, ms. */
const POLL_INTERVAL = 500;

/** Returns the response as JSON. Throws an Error with the message of a failure. */
export async function ask(path, signal) {
  return answered(await fetch(path, { signal, cache: "no-store" }));
}

/** Requests a result that takes long to compute, until it is ready. */
export async function fetchComputed(path, signal) {
  for (;;) {
    const found = await ask(path, signal);
    if (!found.reckoning) return found;
    await new Promise((resolve) => setTimeout(resolve, POLL_INTERVAL));
    signal?.throwIfAborted();
  }
}

/** Performs the action at this path. */
export async function act(path, token, what) {
  const headers = { "content-type": "application/json", "x-calmwalk-token": token };
  return answered(await fetch(path, { method: "POST", headers, body: JSON.stringify(what) }));
}

async function answered(response) {
  const found = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(found.error ?? `the program responded with status ${response.status}`);
  return found;
}

/** Path of a candidate, or of something below it. */
export function candidatePath(id, what = "") {
  return `/api/candidates/${encodeURIComponent(id)}${what}`;
}

const listeners = new Set();
let newest = null;

/** Calls `hear` with the latest update and all that follow, until the signal aborts. */
export function listen(hear, signal) {
  listeners.add(hear);
  signal.addEventListener("abort", () => listeners.delete(hear));
  if (newest) hear(newest);
}

/** Connects to the event stream. `tell` receives the state of the connection and, with updates, the campaign's status. */
export function connect(tell) {
  const source = new EventSource("/api/events");
  source.onopen = () => tell("live");
  source.onerror = () => tell("lost");
  source.onmessage = (event) => {
    const news = JSON.parse(event.data);
    tell(news.error ? "blind" : "live", news.error, news.status);
    if (news.error) return;
    newest = news;
    listeners.forEach((hear) => hear(news));
  };
}
