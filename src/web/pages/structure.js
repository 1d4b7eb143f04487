// A 3D view of the atoms, coloured by γ. Rotate with the mouse or arrow keys; select an atom with the mouse, with , and . or in the table.

import { css, scale } from "./colours.js";
import { element } from "./dom.js";
import { decimals } from "./format.js";

/** Drawn radii, Å: slightly below the covalent radii. */
const RADII = { H: 0.35, C: 0.6, N: 0.58, O: 0.55, F: 0.53, Al: 0.95, Si: 0.9, P: 0.88, S: 0.85, Cl: 0.82 };
const RADIUS = 1.05;
const TURN = Math.PI / 24;

/** Quantities to colour atoms by. */
const BY = { gamma_original: "γ₀, original mixture", gamma_walker: "γ, the walker's mixture", gamma_nbr_original: "γ₀_nbr, original mixture", error: "force error (eV/Å)" };

/** The view with its table. `grades` may be missing. */
export function view(found, grades, labels) {
  const structure = { ...found, positions: found.positions.map((at) => inCell(at, found)) };
  const errors = labels.find((label) => label.status === "label")?.model?.atoms;
  const atoms = structure.species.map((species, k) => ({ ...grades?.[k], atom: k, species, error: errors?.[k], at: structure.positions[k] }));
  const choices = Object.keys(BY).filter((key) => atoms.some((atom) => atom[key] != null));
  const state = { turned: [[1, 0, 0], [0, 0.2, 0.98], [0, -0.98, 0.2]], zoom: 1, picked: null, by: choices[0] };
  const canvas = element("canvas", { tabindex: "0", role: "application", "aria-describedby": "picked",
    "aria-label": `${atoms.length} atoms. Arrow keys rotate, + and − zoom, comma and full stop select an atom; the table has the same numbers.` });
  const selection = element("p", { id: "picked", role: "status" }, "No atom is selected.");
  const legend = element("div", { class: "legend" });
  const rows = new Map();
  const draw = () => paint(canvas, structure, atoms, state);
  const pick = (k) => {
    rows.get(state.picked)?.removeAttribute("aria-selected");
    state.picked = k;
    rows.get(k)?.setAttribute("aria-selected", "true");
    selection.textContent = k == null ? "No atom is selected." : describe(atoms[k]);
    draw();
  };
  const chooser = choices.length > 0 && element("label", {}, "colour by ", element("select", { onchange: (event) => {
    state.by = event.target.value;
    legend.replaceChildren(...scaleOf(atoms, state));
    draw();
  } }, choices.map((key) => element("option", { value: key }, BY[key]))));
  legend.replaceChildren(...scaleOf(atoms, state));
  listen(canvas, atoms, state, draw, pick);
  new ResizeObserver(draw).observe(canvas);
  return element("div", { class: "structure" },
    element("div", {}, canvas, element("div", { class: "below" }, chooser, legend), selection),
    tableOf(atoms, choices, rows, pick));
}

function describe(atom) {
  const numbers = Object.keys(BY).filter((key) => atom[key] != null).map((key) => `${BY[key]} ${decimals(atom[key], 3)}`);
  const place = atom.at.map((x) => decimals(x, 2)).join(", ");
  return [`Atom ${atom.atom}: ${atom.species} at (${place}) Å`, ...numbers, atom.triggered ? "above the collection threshold" : ""].filter(Boolean).join("; ");
}

function largest(atoms, { by }) {
  return atoms.reduce((most, atom) => Math.max(most, atom[by] ?? 0), by === "error" ? 0.1 : 1);
}

function scaleOf(atoms, state) {
  if (!state.by) return [];
  const most = largest(atoms, state);
  const steps = Array.from({ length: 24 }, (_, k) => {
    const step = element("i");
    step.style.background = css(scale(k / 23));
    return step;
  });
  return [element("span", {}, "0"), element("span", { class: "bar", "aria-hidden": "true" }, steps), element("span", {}, decimals(most, 2))];
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

function listen(canvas, atoms, state, draw, pick) {
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
    if (held && held.moved < 4) pick(hit(canvas, atoms, event));
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
    ".": () => next(1), ",": () => next(-1), Escape: () => pick(null),
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

function paint(canvas, structure, atoms, state) {
  const ratio = devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  if (width === 0) return;
  [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const ink = getComputedStyle(canvas).color;
  const corners = cornersOf(structure);
  const centre = middle([...corners, ...structure.positions]);
  const reach = Math.max(...[...corners, ...structure.positions].map((point) => Math.hypot(...point.map((x, k) => x - centre[k]))), 2) + RADIUS;
  // Perspective enlarges the view by 1.4 % at most: 1 / √(1 − 1/36).
  const size = (0.97 * state.zoom * Math.min(width, height)) / 2 / reach;
  const place = (point) => {
    const from = point.map((x, k) => x - centre[k]);
    const [x, y, z] = state.turned.map((row) => row[0] * from[0] + row[1] * from[1] + row[2] * from[2]);
    // A slight perspective shows depth.
    const near = 1 / (1 - z / (6 * reach));
    return { x: width / 2 + x * size * near, y: height / 2 - y * size * near, z, near };
  };
  edges(corners).forEach((edge) => wire(context, edge.map(place), ink));
  const most = largest(atoms, state);
  const balls = atoms.map((atom) => Object.assign(atom, { drawn: place(atom.at) })).sort((a, b) => a.drawn.z - b.drawn.z);
  for (const atom of balls) ball(context, atom, size, state, most, reach, ink);
}

function ball(context, atom, size, state, most, reach, ink) {
  const { x, y, z, near } = atom.drawn;
  const radius = Math.max((RADII[atom.species] ?? RADIUS) * size * near, 2);
  atom.drawn.radius = radius;
  const colour = state.by ? scale((atom[state.by] ?? 0) / most) : [150, 160, 175];
  const depth = 0.12 * (z / reach - 1);
  const shade = context.createRadialGradient(x - radius / 3, y - radius / 3, radius / 8, x, y, radius);
  shade.addColorStop(0, css(colour, 0.55));
  shade.addColorStop(0.35, css(colour, depth));
  shade.addColorStop(1, css(colour, -0.35));
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = shade;
  context.fill();
  context.lineWidth = 0.75;
  context.strokeStyle = css(colour, -0.55);
  context.stroke();
  if (atom.atom !== state.picked) return;
  context.beginPath();
  context.arc(x, y, radius + 3, 0, 2 * Math.PI);
  context.lineWidth = 2.5;
  context.strokeStyle = ink;
  context.stroke();
}

/** The frontmost atom at a position on the screen. */
function hit(canvas, atoms, event) {
  const box = canvas.getBoundingClientRect();
  const [x, y] = [event.clientX - box.left, event.clientY - box.top];
  const under = atoms.filter(({ drawn }) => drawn && Math.hypot(drawn.x - x, drawn.y - y) <= drawn.radius);
  return under.reduce((front, atom) => (front == null || atom.drawn.z > front.drawn.z ? atom : front), null)?.atom ?? null;
}

function wire(context, [from, to], ink) {
  context.beginPath();
  context.moveTo(from.x, from.y);
  context.lineTo(to.x, to.y);
  context.globalAlpha = 0.45;
  context.lineWidth = 1;
  context.strokeStyle = ink;
  context.stroke();
  context.globalAlpha = 1;
}

/** The periodic image of an atom inside the cell. */
function inCell(at, { cell: [a, b, c], periodic }) {
  const volume = dot(a, cross(b, c));
  if (volume === 0) return at;
  const shares = [cross(b, c), cross(c, a), cross(a, b)].map((normal) => dot(at, normal) / volume);
  const whole = shares.map((share, k) => (periodic[k] ? Math.floor(share + 1e-9) : 0));
  return at.map((x, axis) => x - whole[0] * a[axis] - whole[1] * b[axis] - whole[2] * c[axis]);
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** The eight corners of the cell. Empty without a cell. */
function cornersOf({ cell }) {
  if (cell.flat().every((x) => x === 0)) return [];
  return Array.from({ length: 8 }, (_, corner) => [0, 1, 2].map((axis) => cell.reduce((sum, vector, k) => sum + ((corner >> k) & 1) * vector[axis], 0)));
}

/** Pairs of corners that differ in one lattice vector. */
function edges(corners) {
  return corners.flatMap((corner, k) => [1, 2, 4].filter((bit) => !(k & bit)).map((bit) => [corner, corners[k | bit]]));
}

function middle(points) {
  return [0, 1, 2].map((axis) => {
    const values = points.map((point) => point[axis]);
    return (Math.min(...values) + Math.max(...values)) / 2;
  });
}
