// Bounds of the force error by grade, and how often they held.

import { LINES } from "./colours.js";
import { element, table } from "./dom.js";
import { decimals, percent, range, statement, whole } from "./format.js";
import { plot } from "./plot.js";

/** The sentence, a plot, and a table of the bins; a second table of labels by value, which are fitted apart. */
export function errorBounds({ note, found, by_value: byValue }) {
  const parts = [element("p", {}, statement(note))];
  const inUse = [...found.bins, ...(byValue?.bins ?? [])].filter((bin) => bin.in_use && bin.element == null && bin.bound != null)
    .sort((a, b) => (a.above ?? 0) - (b.above ?? 0));
  if (inUse.length > 0) parts.push(element("div", { class: "plots" }, figure(found.level, inUse)));
  if (found.bins.length > 0) {
    parts.push(element("p", {}, `A bound follows from the newest ${whole(found.window_structures)} structures of a bin, and needs `
      + `${whole(found.least_structures)}. Held: mean share of a structure’s atoms below the bounds from before its label came, over the newest `
      + "structures (tested by). Level in force: the level that has made bounds hold as often as they should."),
    bins("Bounds of the force error by γ_nbr", found, byValue != null));
  }
  if (byValue) {
    parts.push(element("p", {}, "From labels of structures that the queue chose by value, which prefers large errors. A bin is in use in place of "
      + "that above where it is more recent, or the only one with enough structures:"),
      bins("Bounds of the force error from labels by value", byValue, true));
  }
  return parts;
}

/** A table of the bins; if there are two, with the column that says which are in use. */
function bins(name, { level, bins: all }, ofTwo) {
  const several = new Set(all.map((bin) => bin.element)).size > 2;
  const columns = [["γ_nbr"], ["element"], ["structures", true], [`${percent(level)} below (eV/Å)`, true], ["mean (eV/Å)", true], ["held", true],
    ["tested by", true], ["level in force", true], ...(ofTwo ? [["in use"]] : [])];
  const shown = all.filter((bin) => several || bin.element == null);
  const rows = shown.map((bin) => [range(bin), bin.element ?? "all", whole(bin.structures), decimals(bin.bound, 3), decimals(bin.mean, 3),
    percent(bin.coverage?.share), whole(bin.coverage?.structures ?? 0), percent(bin.level_in_force), ...(ofTwo ? [bin.in_use ? "yes" : "no"] : [])]);
  return table(name, columns, rows);
}

/** Bound and mean of each bin as steps over γ_nbr. */
function figure(level, pooled) {
  const steps = (key) => pooled.flatMap(({ above, up_to: upTo, [key]: value }) => [[above ?? 0, value], [upTo ?? 1.5 * above, value]]);
  return plot({ title: "Bound of the force error by γ_nbr", x: { title: "γ_nbr", least: 0 }, y: { title: "|ΔF| (eV/Å)", logarithmic: true },
    lines: [{ name: `${percent(level)} below`, colour: LINES[5], points: steps("bound") }, { name: "mean", colour: LINES[0], points: steps("mean") }] });
}
