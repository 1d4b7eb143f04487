// Actions on jobs and walks. Each asks for confirmation and for the token that `calmwalk run` has printed.

import { candidatePath, fetchJson, postAction } from "./api.js";
import { element } from "./dom.js";
import { shortName } from "./format.js";

/** Actions by name: title, states of jobs they apply to, question, and whether they are destructive. */
const ACTIONS = {
  prioritise: { title: "Change priority …", states: ["queued", "leased"] },
  retry: { title: "Retry …", states: ["failed", "dropped"], question: "The structure is queued again with a full number of attempts. Guards do not apply." },
  drop: { title: "Drop …", states: ["queued", "leased", "failed"], question: "The structure will be neither labelled nor exported.", isGrave: true },
};

// The printed address ends with the token. It is removed from the address bar.
const given = location.hash.match(/^#token=([0-9a-f]+)$/);
if (given) {
  sessionStorage.setItem("token", given[1]);
  history.replaceState(null, "", location.pathname);
}

/** Whether this dashboard allows actions. */
const possible = fetchJson("/api/actions").then((allowed) => allowed.possible, () => false);

/** Buttons for the actions on a job. `done` is called after an action. */
export function buttons(job, done) {
  const place = element("p", { class: "actions" });
  possible.then((isPossible) => {
    if (!isPossible) return;
    const allowed = Object.entries(ACTIONS).filter(([, action]) => action.states.includes(job.state));
    place.append(...allowed.map(([name, { title, question, isGrave }]) => {
      const action = { title, question, isGrave, about: shortName(job.candidate), path: candidatePath(job.candidate, `/${name}`),
        priority: name === "prioritise" ? job.priority : null };
      return element("button", { type: "button", class: isGrave && "grave", onclick: () => confirm(action, done) }, title);
    }));
  });
  return place;
}

/** Whether walks can be paused and resumed here. */
export const canPause = () => possible;

/** A button that pauses or resumes a walk, or all walks if `walk` is null. */
export function pauseButton(walk, isPaused, done) {
  const title = isPaused ? "Resume" : "Pause";
  const about = walk == null ? "all unfinished walks" : `walk ${walk}`;
  const question = isPaused ? "It gets assignments again."
    : "It finishes its current assignment and gets no other until it is resumed. In reproducible mode the other walks of its round wait for it.";
  const action = { title, about, question, path: `/api/walks/${walk ?? "all"}/${isPaused ? "resume" : "pause"}` };
  const keep = walk == null ? `${title} all` : `walk ${walk}`;
  // Another button has replaced this one.
  const changed = () => {
    done();
    document.querySelector(`[data-keep="${keep}"]`)?.focus();
  };
  return element("button", { type: "button", class: "small", "aria-label": `${title} ${about} …`, "data-keep": keep,
    onclick: () => confirm(action, changed) }, walk == null ? `${title} all …` : `${title} …`);
}

/** Asks for confirmation and for the token. */
function confirm({ title, about, question, isGrave, path, priority: before }, done) {
  const wrong = element("p", { class: "wrong", role: "alert" });
  const token = element("input", { type: "password", name: "token", autocomplete: "off", required: true, value: sessionStorage.getItem("token") ?? "" });
  const priority = before != null && element("input", { type: "number", step: "1", required: true, value: before });
  const submit = async (event) => {
    event.preventDefault();
    try {
      await postAction(path, token.value, priority ? { priority: priority.valueAsNumber } : {});
      sessionStorage.setItem("token", token.value);
      dialog.close();
      done();
    } catch (error) {
      wrong.textContent = error.message;
    }
  };
  const dialog = element("dialog", { "aria-labelledby": "action-title", onclose: () => dialog.remove() },
    element("form", { onsubmit: submit }, element("h2", { id: "action-title" }, `${title.replace(" …", "")}: ${about}`),
      question && element("p", {}, question),
      priority && element("label", {}, "priority (higher first) ", priority),
      element("label", {}, "token printed by calmwalk run ", token), wrong,
      element("p", { class: "actions" }, element("button", { class: isGrave && "grave" }, "Confirm"),
        element("button", { type: "button", onclick: () => dialog.close() }, "Cancel"))));
  document.body.append(dialog);
  dialog.showModal();
}
