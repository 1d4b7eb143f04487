// The map of feature space: collected structures and the training data behind the mixture along two principal components.

import { fetchComputed } from "./api.js";
import { css, LINES, scale } from "./colours.js";
import { element, section } from "./dom.js";
import { counted, decimals, digits, percent, shortName, whole } from "./format.js";
import { colourBar, colourNames } from "./legend.js";
import { plot } from "./plot.js";

export const TITLE = "Map";

/** Quantities to colour points by. */
const BY = { gamma: "γ₀_max, original mixture", gamma_current: "γ_max at the decision", force_error: "largest force error (eV/Å)", walk: "walk", element: "element" };
const PLACES = { at: "the atom with the largest γ₀ of each structure", mean: "the mean of the atoms of each structure" };
const ALL = "all elements";
/** Points of an ellipse, and its radius in standard deviations. */
const [ROUND, RADIUS] = [48, 2];
/** Width of the map on narrow and on wide screens, and what is beside it. */
const [NARROW, WIDE, MARGINS] = [440, 900, 80];
/** Number of walks with colours of their own. */
const NAMED_WALKS = LINES.length;
const GREY = "#8a8f98";

export async function show(content, address, signal) {
  const chosen = new URLSearchParams(address);
  const again = element("button", { type: "button", onclick: () => load() }, "Recompute");
  const waiting = element("p", { role: "status" }, "Reading features …");
  const place = element("div", {}, waiting);
  content.append(element("p", {}, "Each point is a structure that the campaign collected, at the features of its atoms of one element, along the two "
    + "directions of feature space in which training data and collected atoms together differ most. A point opens its structure. ", again), place);
  const load = async () => {
    place.setAttribute("aria-busy", "true");
    try {
      draw(place, await fetchComputed("/api/map", signal), chosen);
    } catch (error) {
      waiting.remove();
      throw error;
    } finally {
      place.removeAttribute("aria-busy");
    }
  };
  await load();
}

function draw(place, map, chosen) {
  if (map.planes.length === 0) {
    place.replaceChildren(element("p", {}, map.structures.length === 0 ? "No structure has been collected yet."
      : "The features of the collected structures do not differ."));
    return;
  }
  const names = map.planes.map((plane) => plane.element ?? ALL);
  const pick = (key, known) => (known.includes(chosen.get(key)) ? chosen.get(key) : known[0]);
  const plane = map.planes[names.indexOf(pick("element", names))];
  const at = pick("at", Object.keys(PLACES));
  const offered = Object.keys(BY).filter((key) => key === "walk" || (key === "element" ? plane.element == null : plane.points.some((point) => point[key] != null)));
  const by = pick("by", offered);
  const change = (key) => (event) => {
    chosen.set(key, event.target.value);
    history.replaceState(null, "", `#map/${chosen}`);
    draw(place, map, chosen);
    place.querySelector(`[name=${key}]`)?.focus();
  };
  const choice = (label, key, known, name, current) => element("label", {}, label, element("select", { name: key, onchange: change(key) },
    known.map((one) => element("option", { value: one, selected: one === current }, name(one)))));
  const { shade, ring, legend } = colours(by, map, plane);
  const status = element("p", { role: "status", class: "quiet" }, "Arrow keys move from point to point, Enter opens a structure.");
  const drawn = figureOf(map, plane, at, shade, ring);
  keys(drawn, status);
  place.replaceChildren(
    element("div", { class: "filters" }, choice("element", "element", names, (name) => name, plane.element ?? ALL),
      choice("point", "at", Object.keys(PLACES), (key) => PLACES[key], at), choice("colour by", "by", offered, (key) => BY[key], by)),
    section(plane.element ? `Environments of ${plane.element}` : "Environments of all elements",
      element("div", { class: "map" }, drawn), element("p", {}, legend), status, about(map, plane)));
}

/** The colour of a point and, by element, of an ellipse, and the legend. Values above the 98th percentile share the last colour. */
function colours(by, map, plane) {
  const walkOf = (point) => map.structures[point.structure].walk;
  const named = (of, names) => ({ shade: (point) => LINES[names.indexOf(of(point)) % LINES.length],
    legend: colourNames(`${BY[by]}:`, names.map((name, k) => [String(name), LINES[k % LINES.length]])) });
  if (by === "element") {
    const ofElement = named((point) => point.element, [...new Set(plane.points.map((point) => point.element))].sort());
    return { ...ofElement, ring: ofElement.shade };
  }
  const walks = [...new Set(plane.points.map(walkOf))].sort((a, b) => a - b);
  if (by === "walk" && walks.length <= NAMED_WALKS) return named(walkOf, walks);
  const read = by === "walk" ? walkOf : (point) => point[by];
  const values = plane.points.map(read).filter((value) => value != null).sort((a, b) => a - b);
  const low = by === "walk" ? values[0] : 0;
  const high = by === "walk" ? values.at(-1) : values[Math.floor(0.98 * (values.length - 1))] || 1;
  const text = by === "walk" ? whole : (value) => decimals(value, 2);
  const missing = values.length < plane.points.length && colourNames("", [["no label yet", GREY]]);
  return { shade: (point) => (read(point) == null ? GREY : css(scale((read(point) - low) / (high - low || 1)))),
    legend: element("span", {}, colourBar(`${BY[by]}:`, text(low), `${by === "walk" || values.at(-1) <= high ? "" : "≥ "}${text(high)}`), missing) };
}

function figureOf(map, plane, at, shade, ring = () => GREY) {
  const axis = (k) => ({ title: `principal component ${k + 1} (${percent(plane.shares[k])} of the variance)` });
  const mark = (origin, name, shape) => ({ name, shape, colour: LINES[0], points: plane.points
    .filter((point) => map.structures[point.structure].origin === origin)
    .map((point) => [...point[at], `#candidate/${encodeURIComponent(map.structures[point.structure].id)}`, describe(map, point), shade(point)]) });
  const marks = [mark("control", "frame of a control walk", "ring"), mark("biased", "accepted candidate", "circle")];
  const ellipses = plane.components.map((component, k) => ({ name: k === 0 && `training data: component of the mixture, ${RADIUS} standard deviations`,
    colour: ring(component), points: ellipse(component) }));
  const width = Math.min(Math.max(innerWidth - MARGINS, NARROW), WIDE);
  return plot({ title: "", size: [width, Math.round(167 + 0.37 * width)], role: "group", x: axis(0), y: axis(1), lines: ellipses, marks: marks.filter((kind) => kind.points.length > 0) });
}

function describe(map, { structure, element: symbol, atom, gamma, gamma_current: current, force_error: error }) {
  const { id, walk, step } = map.structures[structure];
  const parts = [`walk ${walk}, step ${whole(step)}`, `atom ${atom} (${symbol})`, gamma != null && `γ₀ ${digits(gamma)}`,
    current != null && `γ at the decision ${digits(current)}`, error != null && `largest force error of ${symbol} ${digits(error, "eV/Å")}`];
  return `${shortName(id)}: ${parts.filter(Boolean).join(", ")}`;
}

/** The outline of a Gaussian. */
function ellipse({ centre: [x, y], covariance: [xx, xy, yy] }) {
  const [middle, half] = [(xx + yy) / 2, Math.hypot((xx - yy) / 2, xy)];
  const [long, short] = [middle + half, middle - half].map((variance) => RADIUS * Math.sqrt(Math.max(variance, 0)));
  const angle = Math.atan2(2 * xy, xx - yy) / 2;
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  return Array.from({ length: ROUND + 1 }, (_, k) => {
    const [a, b] = [long * Math.cos((2 * Math.PI * k) / ROUND), short * Math.sin((2 * Math.PI * k) / ROUND)];
    return [x + a * cos - b * sin, y + a * sin + b * cos];
  });
}

/** Arrow keys move the focus to the nearest point in their direction. */
function keys(figure, status) {
  const links = [...figure.querySelectorAll("svg a")];
  const place = (link) => {
    const box = link.getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2];
  };
  links[0]?.setAttribute("tabindex", "0");
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  figure.addEventListener("focusin", (event) => {
    const link = event.target.closest("a");
    if (!link) return;
    links.forEach((one) => one.setAttribute("tabindex", one === link ? "0" : "-1"));
    status.textContent = link.querySelector("title")?.textContent ?? "";
  });
  figure.addEventListener("keydown", (event) => {
    const [way, link] = [ways[event.key], event.target.closest("a")];
    if (!way || !link) return;
    event.preventDefault();
    const [x, y] = place(link);
    const far = (one) => {
      const [a, b] = place(one);
      const along = (a - x) * way[0] + (b - y) * way[1];
      const aside = Math.abs((a - x) * way[1]) + Math.abs((b - y) * way[0]);
      return along > 0.1 ? along + 2 * aside : Infinity;
    };
    const nearest = links.reduce((best, one) => (far(one) < best.far ? { one, far: far(one) } : best), { far: Infinity });
    nearest.one?.focus();
  });
}

function about(map, plane) {
  const part = ({ all, shown }, noun) => (all === shown ? counted(all, noun) : `${whole(shown)} of ${counted(all, noun)}, evenly spread over the decision log`);
  const axes = plane.components.length > 0
    ? `The axes are the principal components of a set of which one half is the training data behind the mixture (its means and covariances: the store keeps no training features) and the other ${counted(plane.sampled_atoms, "collected atom")}. `
      + `${plane.components.length === 1 ? "The ellipse is the component" : `The ellipses are the ${whole(plane.components.length)} components`} of the mixture with which ${map.version == null ? "the campaign" : `version ${map.version} of the potential`} began. `
    : `The axes are the principal components of ${counted(plane.sampled_atoms, "collected atom")}. Training data are not drawn: ${map.mixture_missing ?? "the mixture has no statistics of them"}. `;
  return element("p", { class: "quiet" }, axes, `Shown: ${part(map.accepted, "accepted candidate")}; ${part(map.control, "frame")} of control walks. `,
    `Features have ${whole(map.dimension)} dimensions; distances across the others are not seen here, and γ knows them.`);
}
