// Draws atoms, bonds, cell and axes on a canvas.

import { css } from "./colours.js";
import { bonds, cornersOf, edges, hasCell, middle, minus, plus, shifts } from "./geometry.js";

/** Drawn radii are this part of the covalent radii. */
const PART = 0.8;
/** Share of the canvas that a structure fills. */
const FILLED = 0.97;
const AXES = ["#d55e00", "#009e73", "#0072b2"];

/** What is drawn of a structure: its atoms in `times` cells, with their bonds. */
export function sceneOf(structure, times = [1, 1, 1]) {
  const count = structure.positions.length;
  const copies = shifts(structure, times);
  const places = copies.flatMap((shift) => structure.positions.map((at) => plus(at, shift)));
  const atoms = copies.flatMap(() => structure.species.map((_, atom) => atom));
  const species = atoms.map((atom) => structure.species[atom]);
  const corners = cornersOf(structure, times);
  const cells = copies.flatMap((shift) => edges(cornersOf(structure).map((corner) => plus(corner, shift))));
  const centre = middle([...corners, ...places]);
  const radius = (symbol) => PART * (structure.radii?.[symbol] ?? 1.3);
  const margin = Math.max(...structure.species.map(radius));
  const reach = [...corners, ...places].reduce((most, point) => Math.max(most, Math.hypot(...minus(point, centre))), 2) + margin;
  return { structure, count, places, atoms, species, corners, cells, centre, radius, margin, reach, copies,
    bonds: structure.radii ? bonds(species, places, structure.radii, structure.bond_factor) : [] };
}

/** The largest scale, px/Å, at which all of a scene is seen from its present side. */
export function fitting(scene, turned, width, height) {
  let [across, up] = [1, 1];
  for (const point of [...scene.corners, ...scene.places]) {
    const from = minus(point, scene.centre);
    const [x, y, z] = turned.map((row) => row[0] * from[0] + row[1] * from[1] + row[2] * from[2]);
    const near = nearness(z, scene.reach);
    across = Math.max(across, (Math.abs(x) + scene.margin) * near);
    up = Math.max(up, (Math.abs(y) + scene.margin) * near);
  }
  return FILLED * Math.min(width / 2 / across, height / 2 / up);
}

/** A slight perspective shows depth. */
function nearness(z, reach) {
  return 1 / (1 - z / (6 * reach));
}

/**
 * Draws a scene. `state`: `turned` (rows of a rotation), `scale` (px/Å), `bonds`, `axes`, `picked` and `anchor` (atoms), `measured` (a vector from the anchor).
 * `colour` gives the colour of an atom. Returns the places of the atoms on the canvas: {x, y, z, radius, atom}.
 */
export function paint(canvas, scene, state, colour) {
  const ratio = devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  if (width === 0) return [];
  [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const ink = getComputedStyle(canvas).color;
  const { centre, reach } = scene;
  const { scale: size, turned } = state;
  const place = (point) => {
    const from = minus(point, centre);
    const [x, y, z] = turned.map((row) => row[0] * from[0] + row[1] * from[1] + row[2] * from[2]);
    const near = nearness(z, reach);
    return { x: width / 2 + x * size * near, y: height / 2 - y * size * near, z, near };
  };
  scene.cells.forEach((edge) => wire(context, edge.map(place), ink));
  const balls = scene.places.map((at, k) => {
    const drawn = place(at);
    return { ...drawn, k, atom: scene.atoms[k], radius: Math.max(scene.radius(scene.species[k]) * size * drawn.near * (state.bonds ? 0.55 : 1), 2) };
  });
  const sticks = state.bonds ? scene.bonds.map(([i, j]) => ({ stick: [balls[i], balls[j]], z: (balls[i].z + balls[j].z) / 2 })) : [];
  for (const one of [...balls, ...sticks].sort((a, b) => a.z - b.z)) {
    if (one.stick) stick(context, one.stick, size, reach, colour);
    else ball(context, one, colour(one.atom), reach, state, scene, ink);
  }
  if (state.measured) measure(context, state, scene, place, ink);
  if (state.axes && hasCell(scene.structure)) axes(context, scene.structure.cell, turned, height, ink);
  return balls;
}

function ball(context, { x, y, z, radius, atom, k }, colour, reach, state, scene, ink) {
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
  // Of several images, the one in the first cell is marked.
  const isFirst = k < scene.count;
  if (!isFirst || (atom !== state.picked && atom !== state.anchor)) return;
  context.beginPath();
  context.arc(x, y, radius + 3, 0, 2 * Math.PI);
  context.lineWidth = 2.5;
  context.strokeStyle = ink;
  context.setLineDash(atom === state.picked ? [] : [4, 3]);
  context.stroke();
  context.setLineDash([]);
}

/** Half of a bond has the colour of each atom. */
function stick(context, [from, to], size, reach, colour) {
  const half = { x: (from.x + to.x) / 2, y: (from.y + to.y) / 2 };
  context.lineCap = "round";
  context.lineWidth = Math.max(1.5, 0.22 * size * (from.near + to.near) / 2);
  for (const end of [from, to]) {
    context.beginPath();
    context.moveTo(end.x, end.y);
    context.lineTo(half.x, half.y);
    context.strokeStyle = css(colour(end.atom), -0.12 + 0.08 * (end.z / reach));
    context.stroke();
  }
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

/** A dashed line from the anchor to the nearest image of the selected atom. */
function measure(context, state, scene, place, ink) {
  const start = scene.structure.positions[state.anchor];
  const [from, to] = [place(start), place(plus(start, state.measured))];
  context.beginPath();
  context.setLineDash([6, 4]);
  context.moveTo(from.x, from.y);
  context.lineTo(to.x, to.y);
  context.lineWidth = 2;
  context.strokeStyle = ink;
  context.stroke();
  context.setLineDash([]);
}

/** The directions of the lattice vectors, at the lower left. */
function axes(context, cell, turned, height, ink) {
  const [x, y, length] = [46, height - 46, 30];
  const arrows = cell.map((vector, k) => {
    const norm = Math.hypot(...vector) || 1;
    const [a, b, z] = turned.map((row) => (row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2]) / norm);
    return { name: "abc"[k], colour: AXES[k], x: x + a * length, y: y - b * length, z, a, b };
  });
  context.font = "600 13px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  for (const { name, colour, x: toX, y: toY, a, b } of arrows.sort((p, q) => p.z - q.z)) {
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(toX, toY);
    context.lineWidth = 2.5;
    context.strokeStyle = colour;
    context.stroke();
    context.fillStyle = ink;
    context.fillText(name, toX + 9 * a, toY - 9 * b);
  }
}
