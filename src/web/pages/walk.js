// The trace of one walk: its physical state, its grade and its bias along its steps.

import { fetchJson, listen } from "./api.js";
import { DASHES, FATES, LINES } from "./colours.js";
import { element, facts, section, state, words } from "./dom.js";
import { decimals, digits, tick, whole } from "./format.js";
import { plot } from "./plot.js";

export const TITLE = "Walk";

/** Interval between two reads while the walk runs, ms. */
const INTERVAL = 5000;

export async function show(content, address, signal) {
  const walk = Number.parseInt(address, 10);
  const read = async () => Promise.all([fetchJson(`/api/walks/${walk}/trace`, signal), fetchJson(`/api/walks/${walk}/candidates`, signal)]);
  let [trace, candidates] = await read();
  const [head, plots, inPs] = [element("div"), element("div", { class: "plots" }), element("input", { type: "checkbox" })];
  const draw = () => {
    head.replaceChildren(about({ ...trace, walk: address }));
    plots.replaceChildren(...drawn(trace, candidates, inPs.checked));
  };
  inPs.addEventListener("change", draw);
  content.replaceChildren(element("h1", {}, `Walk ${walk}`), head,
    section("Along the walk", element("p", { class: "filters" }, element("label", {}, inPs, "time axis in ps")), plots));
  draw();
  let last = Date.now();
  listen(async () => {
    if (Date.now() - last < INTERVAL || !["running", "waiting"].includes(trace.state)) return;
    last = Date.now();
    [trace, candidates] = await read().catch(() => [trace, candidates]);
    // Do not replace what has the focus.
    if (!signal.aborted && !plots.contains(document.activeElement)) draw();
  }, signal);
}

function about({ walk, seed_structure: seed, origin, state: how, conditions, points, threshold }) {
  const now = points.at(-1);
  return facts([
    ["seed structure", seed],
    ["origin", origin],
    ["state", state(how)],
    ["group", conditions?.group],
    ["conditions", conditions && `${digits(conditions.temperature, "K")}, τ ${digits(conditions.tau)}${
      conditions.volume_ramp ? `, V/V₀ ${digits(conditions.volume_ramp[0])} to ${digits(conditions.volume_ramp[1])}` : ""}`],
    ["threshold of the collection rule", threshold == null ? null : `γ ${digits(threshold)}`],
    ["newest point", now && `step ${whole(now.step)}, ${digits(now.time / 1000, "ps")}: ${decimals(now.temperature, 0, "K")}`],
    ["candidates", element("a", { href: `#candidates/${new URLSearchParams({ where: `walk = ${walk}` })}` }, "those of this walk")],
    ["points", points.length > 0 ? whole(points.length) : "none yet, or walk.trace_interval = 0"],
  ]);
}

function drawn({ points, threshold, origin }, candidates, inPs) {
  const x = { title: inPs ? "time (ps)" : "step", least: 0, ticks: inPs ? tick : whole };
  const fsPerStep = points.findLast((point) => point.step > 0)?.time / points.findLast((point) => point.step > 0)?.step || 0;
  const at = (step) => (inPs ? (step * fsPerStep) / 1000 : step);
  // A roll back begins a new piece of the line.
  const line = (read) => points.flatMap((point, k) => {
    const begins = k > 0 && points[k - 1].segment !== point.segment;
    return [...(begins ? [[at(point.step), null]] : []), [at(point.step), read(point)]];
  });
  const last = points.at(-1)?.step ?? 0;
  const panel = (title, y, read, more = {}) => plot({ title, x, y, lines: [{ colour: LINES[0], points: line(read) }, ...(more.lines ?? [])], marks: more.marks });
  const first = points.find((point) => point.conserved_energy != null);
  const balance = (point) => (point.conserved_energy == null ? null
    : point.conserved_energy - point.bias_work - (first.conserved_energy - first.bias_work));
  const panels = [
    panel("Temperature", { title: "T (K)" }, (point) => point.temperature),
    panel("Pressure", { title: "P (GPa)" }, (point) => point.pressure),
    panel("Volume", { title: "V/V₀" }, (point) => point.relative_volume),
    grade({ x, at, last, threshold, points, line, candidates }),
  ];
  if (origin === "biased") {
    panels.push(
      panel("Scale of the bias", { title: "τ_r (eV)", least: 0 }, (point) => point.bias_scale),
      panel("Share of the bias", { title: "Σ‖τ_r ∇Σγ‖ / Σ‖F‖ (%)", least: 0 }, (point) => 100 * point.bias_share),
      panel("Work of the bias", { title: "W (eV)" }, (point) => point.bias_work));
    if (points.some((point) => point.cell_gain !== 0)) {
      panels.push(panel("Gain of the bias on the cell", { title: "τ_s", least: 0 }, (point) => point.cell_gain));
    }
  }
  if (points.some((point) => point.cell != null)) panels.push(lengths(points, x, line));
  if (first) panels.push(panel("Energy that is not from the bias", { title: "change (eV)" }, balance));
  return panels;
}

/** γ_max under the walker's mixture and under the original one, candidates under the original one, and the threshold. */
function grade({ x, at, last, threshold, points, line, candidates }) {
  const lines = [{ name: "γ_max, the walker's mixture", colour: LINES[0], points: line((point) => point.gamma_max) }];
  // Points of earlier versions have none.
  if (points.some((point) => point.gamma_max_original != null)) {
    lines.push({ name: "γ₀_max, original mixture", colour: LINES[1], dash: DASHES[2], points: line((point) => point.gamma_max_original) });
  }
  if (threshold != null) lines.push({ name: "threshold", colour: LINES[4], dash: DASHES[1], points: [[0, threshold], [at(last), threshold]] });
  const marks = Object.entries(FATES).map(([name, look]) => ({ name: `${words(name)} (γ₀_max)`, ...look,
    points: candidates.filter((one) => (one.origin === "control" ? "control" : one.fate) === name && one.gamma != null)
      .map((one) => [at(one.step), one.gamma, `#candidate/${encodeURIComponent(one.id)}`, `step ${one.step}: ${words(one.fate)}`]) }));
  return plot({ title: "Grade", x, y: { title: "γ_max, γ₀_max", least: 0 }, lines, marks: marks.filter((kind) => kind.points.length > 0) });
}

function lengths(points, x, line) {
  const edge = (name, k) => ({ name, colour: LINES[k], dash: DASHES[k], points: line((point) => point.cell?.[k]) });
  return plot({ title: "Cell", x, y: { title: "lengths (Å)" }, lines: ["a", "b", "c"].map(edge) });
}
