// Small pictures of the candidates of a page of the table.

import { candidatePath, fetchJson } from "./api.js";
import { css } from "./colours.js";
import { element, state, words } from "./dom.js";
import { elementColours } from "./elements.js";
import { decimals, shortName } from "./format.js";
import { colourNames } from "./legend.js";
import { fitting, paint, sceneOf } from "./painting.js";
import { SIDE, wrapped } from "./structure.js";

/** Structures read at a time. */
const AT_ONCE = 4;

/** The pictures; each opens its candidate. They appear as their structures are read. */
export function gallery(candidates, signal) {
  const legend = element("p", {});
  const cards = candidates.map((candidate) => ({ candidate, canvas: element("canvas", { "aria-hidden": "true" }) }));
  const seen = new Set();
  const waiting = [...cards];
  const work = async () => {
    for (let card = waiting.shift(); card && !signal.aborted; card = waiting.shift()) {
      const found = await fetchJson(candidatePath(card.candidate.id, "/structure"), signal).catch(() => null);
      if (!found) {
        card.canvas.replaceWith(element("span", { class: "missing" }, "The structure cannot be read."));
        continue;
      }
      found.species.forEach((one) => seen.add(one));
      draw(card.canvas, wrapped(found));
      legend.replaceChildren(colourNames("", Object.entries(elementColours([...seen])).map(([name, colour]) => [name, css(colour)])));
    }
  };
  // Begin when the canvases are on the page and have a size.
  requestAnimationFrame(() => Array.from({ length: AT_ONCE }, work));
  return element("div", {}, legend, element("ul", { class: "gallery", "aria-label": "Pictures of the candidates" }, cards.map(card)));
}

function card({ candidate, canvas }) {
  const fate = candidate.origin === "control" ? "control" : candidate.fate;
  return element("li", {}, element("a", { href: `#candidate/${encodeURIComponent(candidate.id)}`, title: candidate.id }, canvas, element("span", { class: "whole" }, shortName(candidate.id))),
    element("span", {}, candidate.formula), element("span", { class: "whole" }, `γ₀_max ${decimals(candidate.gamma, 2)}`),
    element("span", {}, state(fate), candidate.job_state && candidate.job_state !== "labelled" ? ` ${words(candidate.job_state)}` : ""),
    candidate.errors?.force_mae != null && element("span", { class: "whole" }, `F MAE ${decimals(candidate.errors.force_mae, 3, "eV/Å")}`));
}

function draw(canvas, structure) {
  const colours = elementColours(structure.species);
  const scene = sceneOf(structure);
  const scale = fitting(scene, SIDE, canvas.clientWidth, canvas.clientHeight);
  paint(canvas, scene, { turned: SIDE, scale, bonds: structure.positions.length <= 150, axes: false, picked: null, anchor: null, measured: null },
    (atom) => colours[structure.species[atom]]);
}
