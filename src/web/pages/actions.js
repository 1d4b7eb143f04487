// What may be changed from here: asked again before it is done, and with the token that `calmwalk run` has printed.

import { act, ask } from "./api.js";
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

/** Buttons for what may be done with a job; `done` is called when something was. */
export function buttons(job, done, signal) {
  const place = element("p", { class: "actions" });
  ask("/api/actions", signal).then(({ possible }) => {
    if (!possible) return;
    const allowed = Object.entries(ACTIONS).filter(([, action]) => action.states.includes(job.state));
    place.append(...allowed.map(([name, { title, isGrave }]) => element("button", { type: "button", class: isGrave && "grave",
      onclick: () => confirm(name, job, done) }, title)));
  }).catch(() => {});
  return place;
}

function confirm(name, job, done) {
  const { title, question, isGrave } = ACTIONS[name];
  const wrong = element("p", { class: "wrong", role: "alert" });
  const token = element("input", { type: "password", name: "token", autocomplete: "off", required: true, value: sessionStorage.getItem("token") ?? "" });
  const priority = name === "prioritise" && element("input", { type: "number", step: "1", required: true, value: job.priority });
  const submit = async (event) => {
    event.preventDefault();
    try {
      await act(job.candidate, name, token.value, priority ? { priority: priority.valueAsNumber } : {});
      sessionStorage.setItem("token", token.value);
      dialog.close();
      done();
    } catch (error) {
      wrong.textContent = error.message;
    }
  };
  const dialog = element("dialog", { "aria-labelledby": "asked", onclose: () => dialog.remove() },
    element("form", { onsubmit: submit }, element("h2", { id: "asked" }, `${title.replace(" …", "")}: ${shortName(job.candidate)}`),
      question && element("p", {}, question),
      priority && element("label", {}, "priority, higher first ", priority),
      element("label", {}, "token that calmwalk run has printed ", token), wrong,
      element("p", { class: "actions" }, element("button", { class: isGrave && "grave" }, "Do it"),
        element("button", { type: "button", onclick: () => dialog.close() }, "Leave it"))));
  document.body.append(dialog);
  dialog.showModal();
}
