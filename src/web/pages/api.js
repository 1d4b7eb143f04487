// Requests to the program.

/** Interval between requests for a result that is being computed, ms. */
const POLL_INTERVAL = 500;

/** Returns the response as JSON. Throws an Error with the message of a failure. */
export async function fetchJson(path, signal) {
  return parseResponse(await reach(path, { signal, cache: "no-store" }));
}

/** As `fetch`; a connection that is lost has an error that says so. */
export async function reach(path, options) {
  try {
    return await fetch(path, options);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Error("no connection to the program that serves this page");
  }
}

/** Requests a result that takes long to compute, until it is ready. */
export async function fetchComputed(path, signal) {
  for (;;) {
    const found = await fetchJson(path, signal);
    if (!found.computing) return found;
    await new Promise((resolve) => setTimeout(resolve, POLL_INTERVAL));
    signal?.throwIfAborted();
  }
}

/** Performs the action at this path. */
export async function postAction(path, token, what) {
  const headers = { "content-type": "application/json", "x-calmwalk-token": token };
  return parseResponse(await reach(path, { method: "POST", headers, body: JSON.stringify(what) }));
}

async function parseResponse(response) {
  const found = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(found.error ?? `the program responded with status ${response.status}`);
  return found;
}

/** Path of a candidate, or of something below it. */
export function candidatePath(id, what = "") {
  return `/api/candidates/${encodeURIComponent(id)}${what}`;
}

const listeners = new Set();
let latest = null;

/** Calls `listener` with the latest update and all that follow, until the signal aborts. */
export function listen(listener, signal) {
  listeners.add(listener);
  signal.addEventListener("abort", () => listeners.delete(listener));
  if (latest) listener(latest);
}

/** Connects to the event stream. `onState` receives the state of the connection and, with updates, the campaign's status. */
export function connect(onState) {
  const source = new EventSource("/api/events");
  source.onopen = () => onState("live");
  source.onerror = () => onState("lost");
  source.onmessage = (event) => {
    const update = JSON.parse(event.data);
    onState(update.error ? "unreachable" : "live", update.error, update.status);
    if (update.error) return;
    latest = update;
    listeners.forEach((listener) => listener(update));
  };
}
