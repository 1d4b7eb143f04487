// What may be changed from here: asked again before it is done, and with the token that `calmwalk run` has printed.

import { act, ask, candidatePath } from "./api.js";
import { element } from "./dom.js";
import { shortName } from "./format.js";

/** The actions by name: what they say, when they may be done, and whether they take something away. */
const ACTIONS = {
  prioritise: { title: "Give another priority …", states: ["queued", "leased"] },
  retry: { title: "Put back into the queue …", states: ["failed", "dropped"], question: "It is labelled again, past any guard, with all its attempts before it." },
  drop: { title: "Drop …", states: ["queued", "leased", "failed"], question: "It will not be labelled, and not exported.", isGrave: true },
};

// The address that was printed ends with it; it stays out of the address from then on.
const given = location.hash.match(/^#token=([0-9a-f]+)$/);
if (given) {
  sessionStorage.setItem("token", given[1]);
  history.replaceState(null, "", location.pathname);
}

/** Whether anything may be changed here. */
const possible = ask("/api/actions").then((allowed) => allowed.possible, () => false);

/** Buttons for what may be done with a job; `done` is called when something was. */
export function buttons(job, done) {
  const place = element("p", { class: "actions" });
  possible.then((isPossible) => {
    if (!isPossible) return;
    const allowed = Object.entries(ACTIONS).filter(([, action]) => action.states.includes(job.state));
    place.append(...allowed.map(([name, { title, question, isGrave }]) => {
      const asked = { title, question, isGrave, about: shortName(job.candidate), path: candidatePath(job.candidate, `/${name}`),
        priority: name === "prioritise" ? job.priority : null };
      return element("button", { type: "button", class: isGrave && "grave", onclick: () => confirm(asked, done) }, title);
    }));
  });
  return place;
}

/** Whether walks can be paused here, and resumed. */
export const canPause = () => possible;

/** A button that pauses a walk or lets it go on; without a walk, all of them. */
export function pauseButton(walk, isPaused, done) {
  const title = isPaused ? "Resume" : "Pause";
  const about = walk == null ? "all walks that have more steps to make" : `walk ${walk}`;
  const question = isPaused ? "It gets turns again."
    : "It gets no turn after the one in hand, until it is resumed; in reproducible mode the other walks of its round wait for it.";
  const asked = { title, about, question, path: `/api/walks/${walk ?? "all"}/${isPaused ? "resume" : "pause"}` };
  const keep = walk == null ? `${title} all` : `walk ${walk}`;
  // Another button has its place then.
  const changed = () => {
    done();
    document.querySelector(`[data-keep="${keep}"]`)?.focus();
  };
  return element("button", { type: "button", class: "small", "aria-label": `${title} ${about} …`, "data-keep": keep,
    onclick: () => confirm(asked, changed) }, walk == null ? `${title} all …` : `${title} …`);
}

/** Asks whether it is meant, and for the token. */
function confirm({ title, about, question, isGrave, path, priority: before }, done) {
  const wrong = element("p", { class: "wrong", role: "alert" });
  const token = element("input", { type: "password", name: "token", autocomplete: "off", required: true, value: sessionStorage.getItem("token") ?? "" });
  const priority = before != null && element("input", { type: "number", step: "1", required: true, value: before });
  const submit = async (event) => {
    event.preventDefault();
    try {
      await act(path, token.value, priority ? { priority: priority.valueAsNumber } : {});
      sessionStorage.setItem("token", token.value);
      dialog.close();
      done();
    } catch (error) {
      wrong.textContent = error.message;
    }
  };
  const dialog = element("dialog", { "aria-labelledby": "asked", onclose: () => dialog.remove() },
    element("form", { onsubmit: submit }, element("h2", { id: "asked" }, `${title.replace(" …", "")}: ${about}`),
      question && element("p", {}, question),
      priority && element("label", {}, "priority, higher first ", priority),
      element("label", {}, "token that calmwalk run has printed ", token), wrong,
      element("p", { class: "actions" }, element("button", { class: isGrave && "grave" }, "Do it"),
        element("button", { type: "button", onclick: () => dialog.close() }, "Leave it"))));
  document.body.append(dialog);
  dialog.showModal();
}
