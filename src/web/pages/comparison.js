// Biased walks beside their controls, matched by pairs and pooled.

import { LINES } from "./colours.js";
import { element, section, sentence, table } from "./dom.js";
import { decimals, statement, tick, whole } from "./format.js";
import { plot } from "./plot.js";

/** The section; nothing without labelled structures. */
export function comparison({ biased_against_control: compared, large }) {
  if (!compared || compared.pooled.all.structures === 0) return "";
  const { pairs, thresholds, shown } = compared;
  const withStructures = shown.groups.filter(({ place: [kind, walks] }) => compared[kind][walks].structures > 0);
  const named = ({ name, place: [kind, walks] }) => [name, compared[kind][walks]];
  const groups = withStructures.map(named);
  const both = withStructures.filter((group) => group.by_element).map(named);
  return section("Biased against control",
    element("p", {}, "Matched: a labelled candidate of a biased walk and the labelled frame of its control walk at the same step. Pooled: all "
      + "labelled structures, with a partner or without."),
    element("ul", {}, compared.notes.map((note) => element("li", {}, statement(note)))),
    pairs.counts.pairs > 0 && pairTable(pairs, shown.errors), ranges(pairs, shown.errors), groupTable(groups),
    errorTable(groups, shown.errors),
    rankTable(groups, thresholds.indexOf(large), large), areas(both, thresholds), elementTable(both, large));
}

/** A number, and its interval below it. */
function estimate({ value, interval }, digits, factor = 1) {
  const shown = (x) => decimals(factor * x, digits);
  if (value == null) return decimals(null, digits);
  return interval ? element("span", {}, shown(value), element("br"), `(${interval.map(shown).join(" to ")})`) : shown(value);
}

function probability(p) {
  return p != null && p < 1e-3 ? p.toExponential(1).replace("-", "−") : decimals(p, 3);
}

function pairTable(pairs, errors) {
  const columns = [["median over the pairs"], ["pairs", true], ["biased", true], ["control", true], ["difference of medians", true],
    ["biased larger in", true], ["Wilcoxon p", true], ["sign test p", true]];
  const known = errors.map((error) => ({ ...error, of: pairs[error.key] })).filter(({ of }) => of.pairs > 0);
  const rows = known.map(({ name, of, digits, factor }) => [sentence(name), whole(of.pairs),
    estimate(of.biased, digits, factor), estimate(of.control, digits, factor), estimate(of.difference_of_medians, digits, factor),
    `${of.tests.biased_larger} of ${of.tests.biased_larger + of.tests.control_larger}`, probability(of.tests.wilcoxon_p),
    probability(of.tests.sign_p)]);
  return table("Errors over the pairs", columns, rows);
}

/** A range of a median whatever the errors of failed labels are. */
function between([low, high], digits, factor) {
  return high == null ? `at least ${decimals(factor * low, digits)}` : `${decimals(factor * low, digits)} to ${decimals(factor * high, digits)}`;
}

/** What the errors of failed labels could change. */
function ranges(pairs, errors) {
  const sides = ({ key, digits, factor }) => ["biased", "control"].map((side) => [side, pairs[key][`${side}_between`]])
    .filter(([, range]) => range).map(([side, range]) => `${side} ${between(range, digits, factor)}`);
  const lines = errors.filter(({ key }) => pairs[key].pairs > 0).map((error) => [error.name, sides(error)])
    .filter(([, of]) => of.length > 0).map(([name, of]) => `${name} ${of.join(", ")}`);
  return lines.length > 0 && element("p", {}, `Medians over the pairs for any errors of failed labels: ${lines.join("; ")}.`);
}

function groupTable(groups) {
  const columns = [["structures"], ["number", true], ["failed", true], ["seed structures", true], ["walks", true], ["mean T (K)", true],
    ["mean V/V₀", true]];
  const rows = groups.map(([name, group]) => [name, whole(group.structures), whole(group.failed), whole(group.units.seed_structures),
    whole(group.units.walks), decimals(group.mean_temperature, 0), decimals(group.mean_relative_volume, 3)]);
  return table("Groups of structures", columns, rows);
}

/** The medians over the structures of each group. */
function errorTable(groups, errors) {
  const known = errors.filter(({ group_key: key }) => key != null && groups.some(([, group]) => group[key].value != null));
  const columns = [["median over structures"], ...known.map(({ name }) => [name, true]), ["MAE for any errors of failed", true]];
  const rows = groups.map(([name, group]) => [name, ...known.map(({ group_key: key, digits, factor }) => estimate(group[key], digits, factor)),
    group.median_force_mae_between ? between(group.median_force_mae_between, 3, 1) : "–"]);
  return table("Errors of structures, by groups", columns, rows);
}

function rankTable(groups, place, large) {
  const columns = [["structures"], ["median |ΔF| (eV/Å)", true], ["ρ(γ)", true], ["ρ(γ_nbr)", true],
    [`ROC-AUC(γ), error > ${tick(large)} eV/Å`, true], ["ROC-AUC(γ_nbr)", true]];
  const rows = groups.map(([name, { median_error: median, gamma, gamma_nbr: near }]) => [name, estimate(median, 3), estimate(gamma.spearman, 3),
    estimate(near.spearman, 3), estimate(gamma.roc_auc[place] ?? {}, 3), estimate(near.roc_auc[place] ?? {}, 3)]);
  return table("Errors of atoms and their ranks, by groups", columns, rows);
}

/** The ROC-AUC of γ_nbr over the thresholds of the error. */
function areas(groups, thresholds) {
  const line = ([name, group], k) => ({ name, colour: LINES[k % LINES.length], dash: name.startsWith("pooled") ? "6 3" : "",
    points: thresholds.map((threshold, at) => [threshold, group.gamma_nbr.roc_auc[at]?.value ?? null]) });
  return element("div", { class: "plots" }, plot({ title: "ROC-AUC(γ_nbr) by the threshold of the force error",
    x: { title: "threshold (eV/Å)", logarithmic: true }, y: { title: "ROC-AUC", least: 0.5, most: 1 }, lines: groups.map(line) }));
}

/** By element; nothing if all groups have one element. */
function elementTable(groups, large) {
  if (groups.every(([, group]) => group.elements.length < 2)) return "";
  const columns = [["element"], ["of"], ["atoms", true], ["median |ΔF| (eV/Å)", true], ["ρ(γ_nbr)", true],
    [`ROC-AUC(γ_nbr), error > ${tick(large)} eV/Å`, true]];
  const rows = groups.flatMap(([name, group]) => group.elements.map((of) => [of.element, name, whole(of.sampled_atoms),
    estimate(of.median_error, 3), estimate(of.gamma_nbr.spearman, 3), estimate(of.gamma_nbr.roc_auc[0] ?? {}, 3)]));
  rows.sort(([a], [b]) => (a < b ? -1 : a > b ? 1 : 0));
  return table("By element", columns, rows);
}
