// Force errors of the labels by grade.

import { fetchComputed, listen } from "./api.js";
import { errorBounds } from "./calibration.js";
import { LINES } from "./colours.js";
import { comparison } from "./comparison.js";
import { element, section, table } from "./dom.js";
import { decimals, percent, range, tick, whole } from "./format.js";
import { parity } from "./parity.js";
import { plot } from "./plot.js";

export const TITLE = "Errors";

export async function show(content, _, signal) {
  const again = element("button", { type: "button", onclick: () => load() }, "Recompute");
  const place = element("div", { role: "status" }, element("p", {}, "Reading all labels …"));
  content.append(element("p", {}, "Force errors |F_model − F_label| (eV/Å) by the grade of each atom under the original mixture. ", again), place);
  const load = async () => {
    place.setAttribute("aria-busy", "true");
    try {
      place.replaceChildren(...shown(await fetchComputed("/api/errors", signal)));
    } catch (error) {
      // Without labels there is nothing to wait for.
      if (error.name !== "AbortError") place.replaceChildren();
      throw error;
    } finally {
      place.removeAttribute("aria-busy");
    }
  };
  await load();
  let [labels, due] = [null, false];
  listen(({ status }) => {
    const came = labels != null && status.labels.labelled !== labels;
    labels = status.labels.labelled;
    // Load again with the next update: the cached result may be older than the newest label. Do not replace what has the focus.
    if ((came || due) && !place.contains(document.activeElement)) load().catch(() => {});
    due = came;
  }, signal);
}

function shown(errors) {
  const { all } = errors;
  if (all.atoms === 0) return [element("p", {}, "No candidate has a label yet.")];
  return [
    section(`Protocol ${errors.protocol}${errors.version == null ? "" : `, version ${errors.version} of the potential`}`, correlations(errors),
      energies(errors.energy), byVersion(errors),
      element("div", { class: "plots" }, figure("γ", all.gamma), figure("γ_nbr", all.gamma_nbr))),
    parity(errors.parity),
    comparison(errors),
    section("By γ", quantiles("γ", all.gamma, errors.large)), section("By γ_nbr", quantiles("γ_nbr", all.gamma_nbr, errors.large)),
    section("Bounds of the force error", ...errorBounds(errors.calibration)),
    section("Structures without a label", completion("γ₀_max", errors.completion_by_gamma), completion("V/V₀", errors.completion_by_relative_volume)),
  ];
}

function correlations(errors) {
  const columns = [["structures of"], ["structures", true], ["atoms", true], ["mean (eV/Å)", true], ["ρ(γ)", true], ["ρ(γ_nbr)", true],
    [`ROC-AUC(γ), error > ${tick(errors.large)} eV/Å`, true], ["ROC-AUC(γ_nbr)", true]];
  // Biased walks and their controls have intervals, in a section of their own.
  const { structures, atoms, mean_error: mean, gamma, gamma_nbr: near } = errors.all;
  const rows = [["all", whole(structures), whole(atoms), decimals(mean, 4), decimals(gamma.spearman, 3), decimals(near.spearman, 3),
    decimals(gamma.roc_auc, 3), decimals(near.roc_auc, 3)]];
  return table("Rank correlations, and the area under the ROC curve", columns, rows);
}

/** The versions of the potential, each by its own grades; nothing if there is only one. */
function byVersion({ by_version: versions }) {
  if (!versions) return "";
  const columns = [["version", true], ["structures", true], ["atoms", true], ["mean (eV/Å)", true], ["median (eV/Å)", true], ["ρ(γ)", true],
    ["ρ(γ_nbr)", true], ["ROC-AUC(γ)", true], ["ROC-AUC(γ_nbr)", true]];
  const rows = versions.map(({ version, structures, atoms, mean_error: mean, median_error: median, gamma, gamma_nbr: near }) => [whole(version),
    whole(structures), whole(atoms), decimals(mean, 4), decimals(median, 4), decimals(gamma.spearman, 3), decimals(near.spearman, 3),
    decimals(gamma.roc_auc, 3), decimals(near.roc_auc, 3)]);
  return table("By version of the potential, each by its own grades", columns, rows);
}

/** Energy errors without the element offsets, which the note gives; or why there are none. */
function energies({ structures, mean, median, p90, largest, offsets }) {
  const milli = (error) => decimals(1000 * error, 2);
  const line = structures > 0 && `Energy error |E_model − E_label|: mean ${milli(mean)}, median ${milli(median)}, 90 % below ${milli(p90)}, largest `
    + `${milli(largest)} meV/atom over ${whole(structures)} structures. `;
  return element("p", {}, `${line || ""}Note: ${offsets.note}.`);
}

/** Median and percentiles over the middle of each bin. */
function figure(name, { bins }) {
  const filled = bins.filter((bin) => bin.atoms > 0 && bin.median != null);
  const middle = ({ above, up_to: upTo }) => (upTo == null ? 1.25 * above : above == null ? upTo / 2 : (above + upTo) / 2);
  const points = (key) => filled.map((bin) => [middle(bin), bin[key]]);
  return plot({ title: `Force error by ${name}`, x: { title: name, least: 0 }, y: { title: "|ΔF| (eV/Å)", logarithmic: true },
    bands: [{ colour: LINES[0], points: filled.map((bin) => [middle(bin), bin.median, bin.p90]) },
      { colour: LINES[5], points: filled.map((bin) => [middle(bin), bin.p90, bin.p99]) }],
    lines: [{ name: "median", colour: LINES[0], points: points("median") }, { name: "90 %", colour: LINES[0], dash: "6 3", points: points("p90") },
      { name: "99 %", colour: LINES[5], dash: "2 3", points: points("p99") }] });
}

function quantiles(name, { bins }, large) {
  const columns = [[name], ["atoms", true], ["share", true], ["median (eV/Å)", true], ["90 % (eV/Å)", true], ["99 % (eV/Å)", true],
    [`errors > ${tick(large)} eV/Å`, true], ["atoms without a label", true]];
  const rows = bins.map((bin) => [range(bin), whole(bin.atoms), percent(bin.share), decimals(bin.median, 4), decimals(bin.p90, 4),
    decimals(bin.p99, 4), percent(bin.share_large), whole(bin.atoms_without_label)]);
  return table(`Force errors by ${name}`, columns, rows);
}

function completion(name, bins) {
  const columns = [[name], ["labelled", true], ["failed", true], ["share labelled", true], ["95 % interval", true]];
  const rows = bins.filter((bin) => bin.labelled + bin.failed.length > 0).map((bin) => [range(bin), whole(bin.labelled), whole(bin.failed.length),
    percent(bin.share), bin.share_between ? bin.share_between.map(percent).join(" to ") : "–"]);
  return table(`Labels by ${name}`, columns, rows);
}
