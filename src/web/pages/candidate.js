// Details of one candidate, as in `calmwalk explain`, with a view of its atoms.

import { buttons } from "./actions.js";
import { candidatePath, fetchJson } from "./api.js";
import { DASHES, LINES } from "./colours.js";
import { element, facts, section, state, table, words } from "./dom.js";
import { coreTime, counted, decimals, digits, duration, labelValue, percent, shortName, time, whole } from "./format.js";
import { plot } from "./plot.js";
import { view } from "./structure.js";

export const TITLE = "Candidate";

/** Why the search for α ended. */
const ENDS = {
  maximum_below_target: "it brought γ_max below the target",
  inflated: "no α sufficed, but the inflation did",
  inflation_exhausted: "neither an α nor the bounded inflation sufficed",
  count_below_limit: "it left few enough atoms above the threshold",
  fallback_maximum: "no α left few enough atoms above the threshold; this one brought γ_max below the target",
  fallback_last: "no α sufficed; the last one was used",
};

export async function show(content, address, signal) {
  const id = decodeURIComponent(address);
  const [details, structure] = await Promise.all([fetchJson(candidatePath(id), signal), fetchJson(candidatePath(id, "/structure"), signal)]);
  const nav = element("nav", { class: "turn", "aria-label": "Neighbours" });
  content.replaceChildren(element("h1", {}, shortName(details.id)), head(details), nav);
  const { found, grades, decision } = details;
  // The pressed button no longer exists.
  const reload = () => show(content, address, signal).then(() => content.focus());
  content.append(section("Structure", about(details), downloads(details), view(structure, grades?.atoms, details.labels)));
  if (grades) content.append(section("Grades", graded(grades)));
  if (decision) content.append(section("Decision", decided(decision)));
  if (found) content.append(trace(found, grades, signal));
  if (decision) neighbours(nav, decision.number, found, signal);
  if (decision) content.append(...covered(decision.coverage));
  content.append(section("Label", ...labels(details, reload, signal)));
  content.append(section("Not recorded", element("ul", {}, details.not_recorded.map((what) => element("li", {}, what)))));
}

function head({ id, origin, decision, jobs }) {
  const fate = decision && (decision.reason ?? decision.kind);
  return element("p", { class: "head" }, state(origin), fate && fate !== origin && state(fate), jobs.map((job) => state(job.state)), element("code", {}, id));
}

/** Links to the candidates decided before and after, and to those of the same walk. */
async function neighbours(nav, decision, found, signal) {
  const query = (ascending) => `/api/candidates?limit=1&ascending=${ascending}&after=0:${decision}:0`;
  const pages = await Promise.all([false, true].map((ascending) => fetchJson(query(ascending), signal).catch(() => ({ candidates: [] }))));
  const [before, after] = pages.map((page) => page.candidates[0]);
  const to = (one, text) => one && element("a", { href: `#candidate/${encodeURIComponent(one.id)}`, title: one.id }, text);
  const where = new URLSearchParams({ where: `walk = ${found?.walk}` });
  const links = [to(before, "← previous"), found && element("a", { href: `#candidates/${where}` }, `all of walk ${whole(found.walk)}`), to(after, "next →")];
  nav.replaceChildren(...links.filter(Boolean).flatMap((link, k) => (k > 0 ? [" ", link] : [link])));
}

function about({ structure, found, file, frame, same_structure: same, same_import: imported }) {
  const { atoms, formula, volume } = structure;
  const near = found?.distances;
  return facts([
    ["formula", `${formula}, ${whole(atoms)} atoms`],
    ["volume", volume && `${digits(volume, "Å³")} (${digits(volume / atoms, "Å³")} per atom)${found ? `, V/V₀ ${decimals(found.relative_volume, 4)}` : ""}`],
    ["found", found && element("span", {}, element("a", { href: `#walk/${found.walk}` }, `walk ${found.walk}`), ` of seed structure ${found.seed_structure_name}, segment ${found.segment}, step ${whole(found.step)}, `,
      `at ${decimals(found.temperature, 0, "K")}`)],
    ["version of the potential", found?.version > 0 && whole(found.version)],
    ["energy of the potential", found && `${decimals(found.energy / atoms, 4, "eV")} per atom`],
    ["control of", found?.control_of != null && element("span", {}, `walk ${found.control_of}`, found.partner && [": ", link(found.partner)])],
    ["shortest distance", near?.shortest && `${decimals(near.shortest, 3, "Å")} (atoms ${near.atoms.join(" and ")})${required(near.pairs)}`],
    ["imported from", file && `${file}, frame ${frame}`],
    ["same structure", (same.length > 0 || imported) && element("span", {}, same.map((named) => [link(named), " "]).flat(),
      imported && element("a", { href: `#candidate/import-${imported}` }, `import-${imported}`))],
  ]);
}

/** What the selector's guard requires, with the pairs that have the same limit together. */
function required(pairs) {
  const limits = new Map();
  for (const { pair, limit } of pairs) {
    if (limit == null) continue;
    const text = decimals(limit, 3, "Å");
    limits.set(text, [...(limits.get(text) ?? []), pair]);
  }
  const parts = [...limits].map(([limit, of]) => `${limit} of ${of.length > 1 && of.length === pairs.length ? "every pair of elements" : of.join(", ")}`);
  return parts.length === 0 ? "" : `; the selector's guard requires ${parts.join("; ")}`;
}

function link({ candidate, decision }) {
  return element("a", { href: `#candidate/${encodeURIComponent(candidate)}`, title: candidate }, `${shortName(candidate)} (${decision})`);
}

function downloads({ id }) {
  const file = (kind, name) => element("a", { href: candidatePath(id, `/structure.${kind}`), download: "" }, name);
  return element("p", { class: "downloads" }, file("extxyz", "extended XYZ"), " ", file("poscar", "POSCAR"));
}

function graded(grades) {
  const columns = [["mixture"], ["version", true], ["γ_max", true], ["γ_nbr, largest", true], ["atoms with γ > 1", true]];
  const row = (name, grade) => [name, whole(grade.mixture_version), decimals(grade.gamma_max, 3), decimals(grade.gamma_nbr_max, 3), whole(grade.atoms_above_1)];
  const rows = [row("walker", grades.walker), row("selector, at the decision", grades.selector), row("original (γ₀)", grades.original)];
  const { trigger } = grades;
  return element("div", {}, table("Grades under three mixtures", columns, rows), facts([
    ["staleness", grades.staleness > 0 ? `the walker's mixture was ${counted(grades.staleness, "version")} behind` : null],
    ["collection rule", trigger && `requires ${trigger.needed} atoms with γ > ${digits(trigger.threshold)}; there were ` +
      `${trigger.above_walker} under the walker's mixture, ${trigger.above_selector} under the selector's`],
  ]));
}

function decided(decision) {
  const { update } = decision;
  const list = facts([
    ["number", whole(decision.number)],
    ["round", decision.round > 0 ? whole(decision.round) : null],
    ["decision", decision.reason ? `${decision.kind}: ${words(decision.reason)}` : decision.kind],
    ["threshold raised", decision.raised_by && `by a factor of ${digits(decision.raised_by)} to ${digits(decision.raised_threshold)}, because of a long label queue`],
    ["mixture afterwards", `version ${whole(decision.mixture_version)}`],
    ["update", update && `${update.covariance_update ?? ""} with α = ${digits(update.alpha)}; ${ENDS[update.ended_by]}`],
    ["γ_max afterwards", update && decimals(update.gamma_max_after, 3)],
    ["components changed", update && changed(update)],
    ["training atoms with γ > 1", update?.training_frames && percent(update.training_frames.share_above_one)],
  ]);
  if (!update || update.trials.length === 0) return list;
  const columns = [["α", true], ["γ_max", true], ["atoms above", true]];
  return element("div", {}, list, table("Trials of α", columns,
    update.trials.map((trial) => [digits(trial.alpha), decimals(trial.gamma_max, 3), whole(trial.above)])));
}

/** The numbers of the changed components of each element. */
function changed({ components, component_elements: elements }) {
  const numbers = new Map();
  components.forEach(([index, component], k) => {
    const name = elements[k] ?? `element ${index} of the model`;
    numbers.set(name, [...(numbers.get(name) ?? []), component]);
  });
  return [...numbers].map(([name, of]) => `${name} ${of.join(", ")}`).join("; ");
}

/** Earlier candidates of the walk. The store knows the walk's γ only at its candidates. */
function trace(found, grades, signal) {
  const place = element("div", { class: "plots" });
  const draw = (offered) => {
    const before = offered.filter((one) => one.segment === found.segment && one.step <= found.step);
    const points = (key) => before.filter((one) => one[key] != null).map((one) => [one.step, one[key]]);
    const marks = (key, shape, k) => ({ name: key === "gamma" ? "γ₀_max, original mixture" : "γ_max, the walker's mixture", shape, colour: LINES[k],
      points: before.filter((one) => one[key] != null).map((one) => [one.step, one[key], `#candidate/${encodeURIComponent(one.id)}`,
        `step ${one.step}: ${words(one.fate)}`]) });
    place.replaceChildren(plot({ title: `Walk ${found.walk}, segment ${found.segment}: earlier candidates`,
      x: { title: "step", ticks: whole }, y: { title: "γ_max, γ₀_max", least: 0 },
      lines: [{ colour: LINES[0], points: points("gamma") }, { colour: LINES[1], dash: DASHES[1], points: points("walker_gamma") }],
      marks: [marks("gamma", "circle", 0), marks("walker_gamma", "diamond", 1)] }));
  };
  fetchJson(`/api/walks/${found.walk}/candidates`, signal).then(draw).catch(() => {});
  return section("Earlier", place);
}

function covered({ by, later, searched_until: until }) {
  const list = (named) => element("ul", { class: "many" }, named.slice(0, 50).map((one) => element("li", {}, link(one))));
  const more = (named) => (named.length > 50 ? element("p", { class: "quiet" }, `… and ${whole(named.length - 50)} more`) : "");
  const parts = [];
  if (by.length > 0) parts.push(section("Covered by updates of", list(by), more(by)));
  if (later.length > 0) parts.push(section("Covered later", list(later), more(later)));
  if (until) parts.push(element("p", { class: "quiet" }, `Checked up to decision ${whole(until)}.`));
  return parts;
}

function labels({ jobs, labels: made }, reload, signal) {
  if (jobs.length + made.length === 0) return [element("p", {}, "No label job.")];
  return [...jobs.map((found) => element("div", {}, job(found), buttons(found, reload))), ...made.map(label)];
}

/** The value of a queued label with its factors. */
function valueWithFactors({ value, value_factors: factors }) {
  if (!factors || factors.age == null) return labelValue(value);
  return `${labelValue(value)} = expected error ${digits(factors.expected_error)} × completion ${digits(factors.completion)} ÷ cost ${digits(factors.core_hours)}`
    + ` × diversity ${digits(factors.diversity)} × age ${digits(factors.age)}`;
}

function job(found) {
  const { holder, attempts_made: attempts, manual_actions: manual } = found;
  return element("div", {}, facts([
    ["job", `${found.job}, protocol ${found.protocol}`],
    ["state", element("span", {}, state(found.state), ` priority ${found.priority}`)],
    ["value", found.value == null ? null : valueWithFactors(found)],
    ["excluded", found.excluded && `its label is excluded from exports and statistics: ${found.excluded}`],
    ["leased by", holder && `${holder}, until ${time(found.expires)}`],
    ["cost", found.core_seconds == null ? null : coreTime(found.core_seconds / 3600)],
    ["manual actions", manual.map((done) => `${done.action}${done.priority == null ? "" : ` ${done.priority}`}${done.reason ? ` (${done.reason})` : ""}, ${time(done.time)}`).join("; ")],
  ]), attempts.map((made, k) => attempt(made, found.state === "failed" && k === attempts.length - 1)));
}

/** `isWhy`: it is the reason why the job has failed. */
function attempt(made, isWhy) {
  const how = made.outcome ?? "running";
  const lasted = made.ended == null ? `since ${time(made.started)}` : `after ${duration(made.ended - made.started)}`;
  const failed = made.class ? ` (${words(made.class)})` : "";
  const line = `attempt ${made.attempt}: ${how}${failed} ${lasted}, by ${made.holder}`;
  const more = [made.calculation && `calculation ${made.calculation}`, made.remedies && `retry adjustments: ${made.remedies}`, made.difference,
    ["labelled", "check"].includes(made.outcome) ? null : made.log]
    .filter(Boolean).join("\n");
  return more ? element("details", { class: "attempt", open: isWhy }, element("summary", {}, line), element("pre", { tabindex: "0" }, more))
    : element("p", { class: "attempt" }, line);
}

/** The energy error without element offsets, with the offsets; or why there is none. */
function energyError({ energy_error_per_atom: error, energy_offsets: offsets }) {
  if (error != null) return `${decimals(1000 * error, 2, "meV")} per atom; ${offsets.note}`;
  return offsets.structures > 0 ? `not shown: too few labels for this composition; ${offsets.note}` : offsets.note;
}

/** With what the calculation ran after failures. */
function adjustments({ retry_adjustments: names = [] }) {
  if (names.length === 0) return null;
  return names.join(", ") + (names.includes("other_moments") ? " (started from other magnetic moments)" : "");
}

function label(made) {
  const { model } = made;
  return facts([
    [made.status, `protocol ${made.protocol}; ${made.source}; ${time(made.received)}`],
    ["excluded", made.excluded && `${made.excluded.reason}; ${time(made.excluded.time)}`],
    ["superseded", made.superseded && `${made.superseded.reason}; ${time(made.superseded.time)}`],
    ["retry adjustments", adjustments(made.details)],
    ["magnetisation", made.details.magnetisation == null ? null : decimals(made.details.magnetisation, 4, "μ_B")],
    ["energy", `${decimals(made.energy, 6, "eV")} (${decimals(made.energy_per_atom, 6, "eV")} per atom)`],
    ["largest force", decimals(made.max_force, 4, "eV/Å")],
    ["pressure", made.pressure == null ? null : digits(160.2176634 * made.pressure, "GPa")],
    ["energy error of the potential", model && energyError(model)],
    ["force errors of the potential", model && `mean ${decimals(model.mean, 4)}, largest ${decimals(model.largest, 4, "eV/Å")} (atom ${model.atom})`],
  ]);
}
