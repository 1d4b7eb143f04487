// What this page asks the program for.

/** Between two questions for what is being reckoned, ms. */
const PAUSE = 500;

/** The answer as JSON; throws an Error that says why there is none. */
export async function ask(path, signal) {
  return answered(await fetch(path, { signal, cache: "no-store" }));
}

/** The same of what takes long to be reckoned: asks until it is there. */
export async function fetchComputed(path, signal) {
  for (;;) {
    const found = await ask(path, signal);
    if (!found.reckoning) return found;
    await new Promise((resolve) => setTimeout(resolve, PAUSE));
    signal?.throwIfAborted();
  }
}

/** Changes something, which has this path. */
export async function act(path, token, what) {
  const headers = { "content-type": "application/json", "x-calmwalk-token": token };
  return answered(await fetch(path, { method: "POST", headers, body: JSON.stringify(what) }));
}

async function answered(response) {
  const found = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(found.error ?? `the program answers ${response.status}`);
  return found;
}

/** The path of a candidate's own things. */
export function candidatePath(id, what = "") {
  return `/api/candidates/${encodeURIComponent(id)}${what}`;
}

const listeners = new Set();
let newest = null;

/** Calls `hear` with the newest news and with all that come, until the signal. */
export function listen(hear, signal) {
  listeners.add(hear);
  signal.addEventListener("abort", () => listeners.delete(hear));
  if (newest) hear(newest);
}

/** Begins to listen to the program; `tell` hears how the connection is, and with news the campaign's status. */
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
