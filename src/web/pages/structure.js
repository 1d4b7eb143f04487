// A 3D view of the atoms, coloured by γ, force error or element. Rotate with the mouse or arrow keys; select an atom with the mouse, with , and . or in the
// table; m measures distances from the selected atom.

import { css, scale } from "./colours.js";
import { element } from "./dom.js";
import { elementColours } from "./elements.js";
import { decimals } from "./format.js";
import { hasCell, inCell, shortest } from "./geometry.js";
import { colourBar, colourNames } from "./legend.js";
import { fitting, paint, sceneOf } from "./painting.js";

const TURN = Math.PI / 24;
/** The side from which structures are first seen. */
export const SIDE = [[0.9211, -0.3894, 0], [0.0963, 0.2279, 0.9689], [-0.3773, -0.8924, 0.2474]];
/** Largest number of atoms drawn. */
const MAX_ATOMS = 6000;

/** Quantities to colour atoms by. */
const BY = { gamma_original: "γ₀, original mixture", gamma_walker: "γ, the walker's mixture", gamma_nbr_original: "γ₀_nbr, original mixture", error: "force error (eV/Å)" };
const ELEMENT = "element";

/** A structure with its atoms inside the cell. */
export function wrapped(found) {
  return { ...found, positions: found.positions.map((at) => inCell(at, found)) };
}

/** The view with its table. `grades` may be missing. */
export function view(found, grades, labels) {
  const structure = wrapped(found);
  const errors = labels.find((label) => label.status === "label")?.model?.atoms;
  const atoms = structure.species.map((species, k) => ({ ...grades?.[k], atom: k, species, error: errors?.[k], at: structure.positions[k] }));
  const choices = Object.keys(BY).filter((key) => atoms.some((atom) => atom[key] != null));
  const state = { turned: SIDE.map((row) => [...row]), zoom: 1, fit: null, picked: null, anchor: null, measured: null, by: choices[0] ?? ELEMENT, bonds: atoms.length <= 400,
    axes: true, times: [1, 1, 1] };
  let [scene, drawn] = [sceneOf(structure), []];
  const colours = elementColours(structure.species);
  const canvas = element("canvas", { tabindex: "0", role: "application", "aria-describedby": "picked",
    "aria-label": `${atoms.length} atoms. Arrow keys rotate, + and − zoom, comma and full stop select an atom, m measures from it; the table has the same numbers.` });
  const selection = element("p", { id: "picked", role: "status" }, "No atom is selected.");
  const legend = element("div");
  const rows = new Map();
  const draw = () => {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (width === 0) return;
    const now = fitting(scene, state.turned, width, height);
    state.fit ??= now;
    // Turning changes the scale only where a part would be cut off.
    state.scale = state.zoom * Math.min(state.fit, now);
    const most = largest(atoms, state);
    drawn = paint(canvas, scene, state, (atom) => (state.by === ELEMENT ? colours[structure.species[atom]] : scale((atoms[atom][state.by] ?? 0) / most)));
  };
  const pick = (k) => {
    rows.get(state.picked)?.removeAttribute("aria-selected");
    state.picked = k;
    rows.get(k)?.setAttribute("aria-selected", "true");
    const apart = k != null && state.anchor != null && k !== state.anchor;
    state.measured = apart ? shortest(atoms[state.anchor].at, atoms[k].at, structure) : null;
    selection.textContent = k == null ? "No atom is selected." : [describe(atoms[k]), measured(state)].filter(Boolean).join("; ");
    draw();
  };
  const anchor = () => {
    state.anchor = state.picked === state.anchor ? null : state.picked;
    pick(state.picked);
  };
  const explain = () => legend.replaceChildren(state.by === ELEMENT ? colourNames("", Object.entries(colours).map(([name, colour]) => [name, css(colour)]))
    : colourBar(BY[state.by], "0", decimals(largest(atoms, state), 2)));
  const again = () => {
    scene = sceneOf(structure, state.times);
    state.fit = null;
    draw();
  };
  explain();
  listen(canvas, atoms, state, { draw, pick, anchor, drawn: () => drawn });
  new ResizeObserver(() => {
    state.fit = null;
    draw();
  }).observe(canvas);
  return element("div", { class: "structure" },
    element("div", {}, canvas, controls({ state, choices, structure, explain, again, draw, anchor }), legend, selection),
    tableOf(atoms, choices, rows, pick));
}

function controls({ state, choices, structure, explain, again, draw, anchor }) {
  const by = element("label", {}, "colour by ", element("select", { onchange: (event) => {
    state.by = event.target.value;
    explain();
    draw();
  } }, [...choices, ELEMENT].map((key) => element("option", { value: key }, BY[key] ?? "element"))));
  const tick = (key, name) => element("label", {}, element("input", { type: "checkbox", checked: state[key], onchange: (event) => {
    state[key] = event.target.checked;
    draw();
  } }), ` ${name}`);
  // Repeats along periodic directions, as long as there are not too many atoms.
  const most = (n) => n ** structure.periodic.filter(Boolean).length * structure.positions.length;
  const numbers = hasCell(structure) && structure.periodic.some(Boolean) ? [1, 2, 3].filter((n) => n === 1 || most(n) <= MAX_ATOMS) : [1];
  const repeat = numbers.length > 1 && element("label", {}, "cells ", element("select", { onchange: (event) => {
    state.times = structure.periodic.map((is) => (is ? Number(event.target.value) : 1));
    again();
  } }, numbers.map((n) => element("option", { value: n }, structure.periodic.map((is) => (is ? n : 1)).join(" × ")))));
  const measure = element("button", { type: "button", class: "small", onclick: anchor }, "measure from the selected atom");
  return element("div", { class: "below" }, by, tick("bonds", "bonds"), hasCell(structure) && tick("axes", "axes"), repeat, measure);
}

function describe(atom) {
  const numbers = Object.keys(BY).filter((key) => atom[key] != null).map((key) => `${BY[key]} ${decimals(atom[key], 3)}`);
  const place = atom.at.map((x) => decimals(x, 2)).join(", ");
  return [`Atom ${atom.atom}: ${atom.species} at (${place}) Å`, ...numbers, atom.triggered ? "above the collection threshold" : ""].filter(Boolean).join("; ");
}

function measured({ anchor, measured: vector }) {
  if (anchor == null) return "";
  return vector == null ? "distances are measured from it: select another atom" : `${decimals(Math.hypot(...vector), 3, "Å")} from atom ${anchor}, to the nearest image`;
}

function largest(atoms, { by }) {
  return atoms.reduce((most, atom) => Math.max(most, atom[by] ?? 0), by === "error" ? 0.1 : 1);
}

function tableOf(atoms, choices, rows, pick) {
  if (choices.length === 0) return "";
  const order = [...atoms].sort((a, b) => b[choices[0]] - a[choices[0]]);
  const lines = order.map((atom) => {
    const button = element("button", { type: "button", class: "pick", onclick: () => pick(atom.atom) }, String(atom.atom));
    const row = element("tr", {}, element("td", {}, button), element("td", {}, atom.species, atom.triggered ? " ▲" : ""),
      choices.map((key) => element("td", { class: "number" }, decimals(atom[key], 3))));
    rows.set(atom.atom, row);
    return row;
  });
  const titles = ["atom", "element", ...choices.map((key) => BY[key])];
  return element("div", { class: "scrolls atoms", role: "region", tabindex: "0", "aria-label": "Atoms" }, element("table", {},
    element("caption", {}, "Atoms; ▲: above the collection threshold"),
    element("thead", {}, element("tr", {}, titles.map((title, k) => element("th", { scope: "col", class: k > 1 && "number" }, title)))),
    element("tbody", {}, lines)));
}

function listen(canvas, atoms, state, { draw, pick, anchor, drawn }) {
  let held = null;
  canvas.addEventListener("pointerdown", (event) => {
    held = { x: event.clientX, y: event.clientY, moved: 0 };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    const [x, y] = [event.clientX - held.x, event.clientY - held.y];
    held = { x: event.clientX, y: event.clientY, moved: held.moved + Math.abs(x) + Math.abs(y) };
    turn(state, y / 120, x / 120);
    draw();
  });
  canvas.addEventListener("pointerup", (event) => {
    if (held && held.moved < 4) pick(hit(canvas, drawn(), event));
    held = null;
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(state, Math.exp(-event.deltaY / 500));
    draw();
  }, { passive: false });
  const next = (by) => pick((((state.picked ?? (by > 0 ? -1 : 0)) + by) + atoms.length) % atoms.length);
  const keys = {
    ArrowLeft: () => turn(state, 0, -TURN), ArrowRight: () => turn(state, 0, TURN), ArrowUp: () => turn(state, -TURN, 0),
    ArrowDown: () => turn(state, TURN, 0), "+": () => zoom(state, 1.15), "=": () => zoom(state, 1.15), "-": () => zoom(state, 1 / 1.15),
    ".": () => next(1), ",": () => next(-1), m: anchor, Escape: () => pick(null),
  };
  canvas.addEventListener("keydown", (event) => {
    const act = keys[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
    draw();
  });
}

function zoom(state, factor) {
  state.zoom = Math.min(Math.max(state.zoom * factor, 0.2), 20);
}

/** Rotates about the screen's axes: down and to the right. */
function turn(state, down, right) {
  const [c, s, k, l] = [Math.cos(right), Math.sin(right), Math.cos(down), Math.sin(down)];
  const [x, y, z] = state.turned;
  const row = (a, u, b, v) => a.map((value, n) => value * u + b[n] * v);
  const [x1, z1] = [row(x, c, z, s), row(z, c, x, -s)];
  state.turned = [x1, row(y, k, z1, -l), row(z1, k, y, l)];
}

/** The frontmost atom at a position on the screen. */
function hit(canvas, drawn, event) {
  const box = canvas.getBoundingClientRect();
  const [x, y] = [event.clientX - box.left, event.clientY - box.top];
  const under = drawn.filter((ball) => Math.hypot(ball.x - x, ball.y - y) <= ball.radius);
  return under.reduce((front, ball) => (front == null || ball.z > front.z ? ball : front), null)?.atom ?? null;
}
