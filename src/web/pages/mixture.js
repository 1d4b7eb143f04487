// The mixture in force: its components by element, and how far each has moved since the campaign began.

import { fetchComputed } from "./api.js";
import { LINES } from "./colours.js";
import { drawing, element, facts, section, table } from "./dom.js";
import { decimals, digits, whole } from "./format.js";

export const TITLE = "Mixture";

const ELEMENTS = [["element"], ["components", true], ["moved", true], ["environments at the start", true], ["gained", true],
  ["largest condition number", true], ["largest component distance", true], [""]];
const COMPONENTS = [["component", true], ["θ", true], ["environments at the start", true], ["gained", true], ["weighted", true],
  ["condition number", true], ["widest growth", true], ["strongest shrinkage", true], ["training σ²", true], ["component distance", true], [""]];

/** Width of the longest bar. */
const BAR = 100;

export async function show(content, chosen, signal) {
  const again = element("button", { type: "button", onclick: () => load() }, "Recompute");
  const waiting = element("p", { role: "status" }, "Reading the mixture …");
  const place = element("div", {}, waiting);
  content.append(element("p", {}, "The Gaussians that grade structures. An accepted structure widens those of its elements. ",
    "The eigenvalues λ of a covariance C relative to the initial one, C₀, measure how far it has moved. ", again), place);
  const load = async () => {
    place.setAttribute("aria-busy", "true");
    try {
      const mixture = await fetchComputed("/api/mixture", signal);
      place.replaceChildren(...shown(mixture, decodeURIComponent(chosen)));
    } catch (error) {
      waiting.remove();
      throw error;
    } finally {
      place.removeAttribute("aria-busy");
    }
  };
  await load();
}

function shown(mixture, chosen) {
  const elements = byElement(mixture.components);
  const farthest = [...elements].sort((a, b) => (b.distance ?? 0) - (a.distance ?? 0))[0];
  const one = elements.find(({ name }) => name === chosen) ?? farthest;
  const place = element("div");
  const choose = (found) => {
    history.replaceState(null, "", `#mixture/${encodeURIComponent(found.name)}`);
    place.replaceChildren(components(found));
    for (const button of document.querySelectorAll("button.pick")) button.setAttribute("aria-pressed", button.textContent === found.name);
  };
  const all = [overall(mixture), section("Elements", byName(elements, one, choose)), place];
  place.replaceChildren(components(one));
  return all;
}

function overall({ version, decision, feature_dimension: dimension, components }) {
  const moved = components.filter((component) => component.moved).length;
  return facts([["version", whole(version)], ["after decision", whole(decision)], ["features", `${whole(dimension)} dimensions`],
    ["components", whole(components.length)], ["moved", `${whole(moved)} since the start`]]);
}

/** Sums and extremes of each element, in the order of the potential. */
function byElement(components) {
  const groups = new Map();
  for (const component of components) {
    if (!groups.has(component.element)) groups.set(component.element, []);
    groups.get(component.element).push(component);
  }
  return [...groups].map(([name, own]) => {
    const sum = (key) => (own.some((one) => one[key] == null) ? null : own.reduce((total, one) => total + one[key], 0));
    const largest = (key) => own.reduce((most, one) => (one[key] != null && (most == null || one[key] > most) ? one[key] : most), null);
    return { name, own, moved: own.filter((one) => one.moved).length, before: sum("environments_before"), now: sum("environments"),
      condition: largest("condition_number"), distance: largest("distance") };
  });
}

function byName(elements, one, choose) {
  const most = Math.max(...elements.map(({ distance }) => distance ?? 0));
  const rows = elements.map((found) => [
    element("button", { type: "button", class: "pick", "aria-pressed": String(found === one), onclick: () => choose(found) }, found.name),
    whole(found.own.length), whole(found.moved), whole(found.before), gained(found.before, found.now), power(found.condition),
    digits(found.distance), bar(found.distance, most)]);
  return table("Elements; select one to see its components", ELEMENTS, rows);
}

function components({ name, own }) {
  const most = Math.max(...own.map(({ distance }) => distance ?? 0));
  const rows = own.map((one) => [whole(one.component), decimals(one.threshold, 4), whole(one.environments_before),
    gained(one.environments_before, one.environments), decimals(one.weighted, 1), power(one.condition_number), times(one.grown), times(one.shrunk), times(one.mean_square_growth),
    one.moved ? digits(one.distance) : "not moved", bar(one.distance, most)]);
  return section(`Components of ${name}`, table(`Components of ${name}`, COMPONENTS, rows),
    element("p", { class: "quiet" }, "θ: calibrated threshold of σ. Condition number of C + εI. Widest growth √λ_max and strongest shrinkage √λ_min: ",
      "factors on the width, in the direction of feature space that changed most. Training σ²: factor on the mean σ² of the training atoms; what the mixture forgets grows. Distance: √Σ ln²λ, 0 if it has not moved. All are dimensionless."));
}

function gained(before, now) {
  return before == null || now == null ? null : whole(now - before);
}

/** An order of magnitude. */
function power(value) {
  return value == null ? null : value.toExponential(1);
}

function times(factor) {
  return factor == null ? null : `× ${digits(factor)}`;
}

/** The value of the previous cell as a bar. */
function bar(value, most) {
  if (!(value > 0)) return "";
  return drawing("svg", { class: "length", width: BAR, height: 10, "aria-hidden": "true" },
    drawing("rect", { width: Math.max(1, (BAR * value) / most), height: 10, fill: LINES[0] }));
}
