// Versions of the potential: their errors by data set, and what they cost.

import { DASHES, LINES } from "./colours.js";
import { element, section, sentence, state, table } from "./dom.js";
import { decimals, digits, duration, time, whole } from "./format.js";
import { plot } from "./plot.js";

const COLUMNS = [["version", true], ["state"], ["trained from", true], ["labels", true], ["accepted", true], ["labelled", true],
  ["wall time", true], ["core-hours", true], ["since"], ["refused because"]];
const ERRORS = [["version", true], ["set"], ["structures", true], ["energy MAE (meV/atom)", true], ["force MAE (eV/Å)", true],
  ["force RMSE (eV/Å)", true], ["stress MAE (GPa)", true], ["from parent (%)", true], ["from version 0 (%)", true]];

/** A section about the versions; nothing in a campaign that has never trained one. */
export function versions({ versions: all }) {
  if (all.length === 0) return "";
  return section("Versions of the potential", list(all), element("div", { class: "plots" }, chart(all)), errors(all));
}

function list(all) {
  const rows = all.map((one) => [whole(one.number), state(one.state), one.parent == null ? null : whole(one.parent), whole(one.labels),
    whole(one.accepted), whole(one.labelled), one.number > 0 ? duration(1000 * one.seconds) : null,
    one.number > 0 ? digits(one.core_hours) : null, one.time == null ? null : time(one.time), one.reason && sentence(one.reason)]);
  return table("Versions of the potential", COLUMNS, rows);
}

function errors(all) {
  const rows = all.flatMap((one) => one.errors.map((set) => {
    const { energy_mae: energy, force_mae: force, force_rmse: rmse, stress_mae: stress } = set.version ?? {};
    return [whole(one.number), set.name, whole(set.structures), energy == null ? null : decimals(1000 * energy, 1), decimals(force, 4),
      decimals(rmse, 4), digits(stress == null ? null : 160.2176634 * stress), change(set.parent?.force_mae, force), change(set.first?.force_mae, force)];
  }));
  return table("Errors by version and data set", ERRORS, rows);
}

/** A relative change in per cent, with its sign. */
function change(before, after) {
  if (!(before > 0) || after == null) return null;
  const share = Math.round((100 * (after - before)) / before);
  return `${share > 0 ? "+" : ""}${decimals(share, 0)}`;
}

/** Force MAE against the labels in the training set: a line for each data set, and crosses for refused versions. */
function chart(all) {
  const names = [...new Set(all.flatMap((one) => one.errors.map((set) => set.name)))];
  const points = (name, isRefused) => all.filter((one) => (one.state === "refused") === isRefused).flatMap((one) => {
    const force = one.errors.find((set) => set.name === name)?.version?.force_mae;
    return force > 0 ? [[one.labels, force, null, `version ${one.number}, ${name}`]] : [];
  });
  const colour = (k) => LINES[k % LINES.length];
  const lines = names.map((name, k) => ({ name, colour: colour(k), dash: DASHES[Math.floor(k / LINES.length) % DASHES.length],
    points: points(name, false) }));
  const marks = names.flatMap((name, k) => [
    { colour: colour(k), shape: "circle", points: points(name, false) }, { colour: colour(k), shape: "cross", points: points(name, true) }]);
  return plot({ title: "Force errors by number of labels (crosses: refused)", x: { title: "labels in the training set", least: 0, ticks: whole },
    y: { title: "force MAE (eV/Å)", logarithmic: true }, lines, marks: marks.filter((kind) => kind.points.length > 0) });
}
