// Values of the potential against those of labels, with their mean errors.

import { LINES } from "./colours.js";
import { element, section, table } from "./dom.js";
import { decimals, shortName, tick, whole } from "./format.js";
import { plot } from "./plot.js";

/** GPa in 1 eV/Å³. */
const GPA = 160.2176634;
/** Quantities: title, unit and factor of values, unit, factor and decimals of errors, and what is counted. */
const QUANTITIES = {
  energy: ["Energy", "eV per atom", 1, "meV per atom", 1000, 2, "structures"],
  force: ["Force", "eV/Å", 1, "eV/Å", 1, 4, "components"],
  stress: ["Stress", "GPa", GPA, "GPa", GPA, 3, "components"],
};

/** The section; nothing without values. */
export function parity(found) {
  const known = Object.entries(QUANTITIES).filter(([key]) => found?.[key]?.number > 0);
  if (known.length === 0) return "";
  const rows = known.map(([key, [title, , , unit, factor, digits, counted]]) => [title, decimals(factor * found[key].mae, digits, unit),
    decimals(factor * found[key].rmse, digits, unit), `${whole(found[key].number)} ${counted}`]);
  return section("The potential against labels",
    table("Mean errors of the potential", [["quantity"], ["MAE", true], ["RMSE", true], ["over", true]], rows),
    element("div", { class: "plots" }, known.map(([key, quantity]) => figure(found[key].points, quantity))),
    element("p", { class: "quiet" }, "MAE: mean absolute error. RMSE: root mean square error. Energies are per atom without the offsets of the elements, in the zero of the potential; ",
      "forces and stresses are components. The line marks equal values. Of many values, an even sample is drawn; the errors are of all. A point opens its structure."));
}

function figure(points, [title, unit, factor]) {
  const mark = (origin, look) => ({ name: origin, ...look, points: points.filter((point) => point.origin === origin).map(({ label, model, id }) =>
    [factor * label, factor * model, `#candidate/${encodeURIComponent(id)}`, `${shortName(id)}: label ${tick(factor * label)}, potential ${tick(factor * model)} ${unit}`]) });
  const ends = points.flatMap(({ label, model }) => [factor * label, factor * model]);
  const [low, high] = [ends.reduce((a, b) => Math.min(a, b)), ends.reduce((a, b) => Math.max(a, b))];
  const marks = [mark("control", { colour: LINES[0], shape: "square" }), mark("biased", { colour: LINES[1], shape: "circle" })];
  return plot({ title: `${title}: potential against label`, x: { title: `label (${unit})` }, y: { title: `potential (${unit})` },
    lines: [{ name: "equal", colour: "#8a8f98", dash: "4 3", points: [[low, low], [high, high]] }], marks: marks.filter((kind) => kind.points.length > 0) });
}
