// Vectors, cells and bonds of a structure, Å.

/** Largest number of atoms between which bonds are searched. */
const MAX_BONDED = 2500;

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** a + k b */
export const plus = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** The periodic image of an atom inside the cell. */
export function inCell(at, { cell: [a, b, c], periodic }) {
  const volume = dot(a, cross(b, c));
  if (volume === 0) return at;
  const shares = [cross(b, c), cross(c, a), cross(a, b)].map((normal) => dot(at, normal) / volume);
  const whole = shares.map((share, k) => (periodic[k] ? Math.floor(share + 1e-9) : 0));
  return [a, b, c].reduce((moved, vector, k) => plus(moved, vector, -whole[k]), at);
}

/** Whether the cell has a volume. */
export function hasCell({ cell }) {
  return cell.flat().some((x) => x !== 0);
}

/** The eight corners of `times` cells. Empty without a cell. */
export function cornersOf(structure, times = [1, 1, 1]) {
  if (!hasCell(structure)) return [];
  return Array.from({ length: 8 }, (_, corner) => structure.cell.reduce((sum, vector, k) => plus(sum, vector, ((corner >> k) & 1) * times[k]), [0, 0, 0]));
}

/** Pairs of corners that differ in one lattice vector. */
export function edges(corners) {
  return corners.flatMap((corner, k) => [1, 2, 4].filter((bit) => !(k & bit)).map((bit) => [corner, corners[k | bit]]));
}

/** Multiples of the lattice vectors from 0 to below `times`. */
export function shifts({ cell }, times) {
  const all = [];
  for (let i = 0; i < times[0]; i += 1) {
    for (let j = 0; j < times[1]; j += 1) {
      for (let k = 0; k < times[2]; k += 1) all.push(plus(plus(plus([0, 0, 0], cell[0], i), cell[1], j), cell[2], k));
    }
  }
  return all;
}

export function middle(points) {
  return [0, 1, 2].map((axis) => {
    const values = points.map((point) => point[axis]);
    return (values.reduce((a, b) => Math.min(a, b)) + values.reduce((a, b) => Math.max(a, b))) / 2;
  });
}

/** Pairs of places that are bonded: closer than `factor` times the sum of their radii. Bonds through the walls of the box are left out. */
export function bonds(species, places, radii, factor) {
  if (places.length > MAX_BONDED) return [];
  const reach = 2 * factor * Object.values(radii).reduce((a, b) => Math.max(a, b), 0.1);
  const box = (at) => at.map((x) => Math.floor(x / reach));
  const boxes = new Map();
  places.forEach((at, k) => {
    const key = box(at).join();
    boxes.set(key, [...(boxes.get(key) ?? []), k]);
  });
  const found = [];
  places.forEach((at, i) => {
    const [x, y, z] = box(at);
    for (const near of [-1, 0, 1].flatMap((a) => [-1, 0, 1].flatMap((b) => [-1, 0, 1].map((c) => [x + a, y + b, z + c])))) {
      for (const j of boxes.get(near.join()) ?? []) {
        if (j > i && Math.hypot(...minus(places[j], at)) < factor * (radii[species[i]] + radii[species[j]])) found.push([i, j]);
      }
    }
  });
  return found;
}

/** The shortest vector from one place to a periodic image of another. */
export function shortest(from, to, { cell, periodic }) {
  const around = periodic.map((is) => (is ? [-2, -1, 0, 1, 2] : [0]));
  const images = around[0].flatMap((i) => around[1].flatMap((j) => around[2].map((k) =>
    minus(plus(plus(plus(to, cell[0], i), cell[1], j), cell[2], k), from))));
  return images.reduce((best, one) => (dot(one, one) < dot(best, best) ? one : best));
}
