// The table of candidates. The program sorts, filters and pages; this script shows one page.

import { fetchJson, reach } from "./api.js";
import { FATES } from "./colours.js";
import { element, renew, state, titleOf, words } from "./dom.js";
import { decimals, labelValue, shortName, whole } from "./format.js";
import { gallery } from "./gallery.js";

export const TITLE = "Candidates";

const LENGTH = 50;
const STATES = ["queued", "leased", "labelled", "failed", "dropped", "superseded"];
/** Columns: title, whether it is numeric, and the sort order of its title. */
const COLUMNS = [["candidate", false, "walk"], ["decision", true, "decision"], ["fate", false, "fate"], ["label", false, "state"], ["priority", true, "queue"], ["value", true, "value"],
  ["γ_max", true, "gamma_current"], ["γ₀_max", true, "gamma"], ["γ₀_nbr", true, "gamma_nbr"], ["V/V₀", true, "relative_volume"], ["T", true, "temperature"],
  ["seed structure", false, "seed_structure"], ["formula", false, "formula"], ["atoms", true, "atoms"],
  ["E potential (eV per atom)", true, "potential_energy"], ["E label (eV per atom)", true, "energy"], ["ΔE (meV per atom)", true, "energy_error"],
  ["F MAE (eV/Å)", true, "force_mae"], ["largest ΔF (eV/Å)", true, "max_force_error"], ["ΔStress (GPa)", true, "stress_error"],
  ["F_max label (eV/Å)", true, "max_force"], ["attempts", true, "attempts"]];
/** Orders in which large values come first without being asked. */
const FALLING = ["queue"];
/** GPa in 1 eV/Å³. */
const GPA = 160.2176634;

export function show(content, rest, signal) {
  // The query is part of the address, so that it can be bookmarked and shared.
  const params = new URLSearchParams(rest);
  const [place, progress] = [element("div"), element("p", { role: "status" })];
  const change = (changes) => {
    for (const [key, value] of Object.entries(changes)) value ? params.set(key, value) : params.delete(key);
    // The queue order applies to one state.
    if (params.get("order") === "queue" && !params.get("state")) params.set("state", "queued");
    history.replaceState(null, "", `#candidates/${params}`);
    pages.length = 0;
    load(null);
  };
  const pages = [];
  let last = 0;
  const load = async (after) => {
    const mine = ++last;
    const wait = setTimeout(() => {
      place.setAttribute("aria-busy", "true");
      if (progress.textContent === "") progress.textContent = "Reading candidates …";
    }, 200);
    try {
      const page = await fetchPage(params, after, signal, (searched) => {
        if (mine === last) progress.textContent = `${whole(searched)} candidates searched …`;
      }, () => mine !== last);
      if (mine === last) renew(place, ...lines(page, params, change, pages, after, load, signal));
    } catch (error) {
      if (error.name !== "AbortError" && mine === last) place.replaceChildren(element("p", { class: "wrong", role: "alert" }, error.message));
    } finally {
      clearTimeout(wait);
      if (mine === last) {
        progress.textContent = "";
        place.removeAttribute("aria-busy");
      }
    }
  };
  content.append(filters(params, change), tools(params, change, signal), progress, place);
  return load(null);
}

/** A filter with few matches takes several requests. */
async function fetchPage(params, after, signal, onProgress, isStale) {
  let [found, searched, next, imported, sorted] = [[], 0, after, null, null];
  do {
    const query = asked(params);
    query.set("limit", LENGTH - found.length);
    if (next) query.set("after", next);
    const page = await fetchJson(`/api/candidates?${query}`, signal);
    found = found.concat(page.candidates.map((one, k) => ({ ...one, version: page.versions?.[k], errors: page.errors[k] })));
    searched += page.scanned;
    imported = page.imported;
    sorted = page.sorted_among;
    next = page.next;
    if (next && found.length < LENGTH) onProgress(searched);
  } while (next && found.length < LENGTH && !isStale());
  return { candidates: found, next, imported, sorted };
}

/** The parameters that the program knows. */
function asked(params) {
  const query = new URLSearchParams(params);
  query.delete("view");
  return query;
}

/** Table or pictures, and the file of what is selected. */
function tools(params, change, signal) {
  const said = element("span", { role: "status" });
  const get = async () => {
    said.textContent = "collecting …";
    try {
      const query = asked(params);
      // The order of a column without an index is not that of a file.
      if (!["decision", "gamma", "relative_volume", "queue"].includes(query.get("order") ?? "decision")) ["order", "ascending"].forEach((key) => query.delete(key));
      const response = await reach(`/api/candidates.extxyz?${query}`, { signal });
      if (!response.ok) throw new Error((await response.json().catch(() => ({}))).error ?? `status ${response.status}`);
      const address = URL.createObjectURL(await response.blob());
      element("a", { href: address, download: "candidates.extxyz" }).click();
      setTimeout(() => URL.revokeObjectURL(address), 60000);
      said.textContent = "saved as candidates.extxyz";
      said.className = "quiet";
    } catch (error) {
      if (error.name === "AbortError") return;
      said.textContent = error.message;
      said.className = "wrong";
    }
  };
  const look = element("select", { onchange: (event) => change({ view: event.target.value }) },
    element("option", { value: "" }, "table"), element("option", { value: "pictures", selected: params.get("view") === "pictures" }, "pictures"));
  return element("div", { class: "filters" }, element("label", {}, "show as", look),
    element("button", { type: "button", onclick: get }, "Download what is selected (extended XYZ)"), said);
}

function filters(params, change) {
  const choice = (label, key, names) => element("label", {}, label, element("select", { onchange: (event) => change({ [key]: event.target.value }) },
    element("option", { value: "" }, "all"), names.map((name) => element("option", { value: name, selected: params.get(key) === name }, words(name)))));
  const where = element("input", { type: "search", size: 34, value: params.get("where") ?? "", placeholder: "gamma > 2 and element = Mo",
    spellcheck: "false", autocomplete: "off" });
  const submit = (event) => {
    event.preventDefault();
    change({ where: where.value.trim() });
  };
  return element("form", { class: "filters", role: "search", onsubmit: submit }, choice("fate", "fate", Object.keys(FATES)),
    choice("label", "state", STATES), element("label", {}, "where", where), element("button", {}, "Show"),
    element("details", {}, element("summary", {}, "Syntax"), element("p", {},
      "gamma (γ₀_max), gamma_nbr (γ₀_nbr; both under the original mixture), gamma_current (γ_max at the decision), relative_volume (V/V₀), kinetic_temperature (K), temperature, tau, version (of the potential) and group of its walk, walk, step, mixture_version (after the decision), atoms, " +
      "energy (eV), energy_per_atom and max_force (eV/Å) of the label, with = != < <= > >=; " +
      "element, origin (biased or control), seed_structure, retry_adjustment with = and !=; and, or, not and parentheses. " +
      "A comparison with a missing value, such as the energy of an unlabelled candidate, is false.")));
}

function lines({ candidates, next, imported, sorted }, params, change, pages, after, load, signal) {
  const order = params.get("order") || "decision";
  const ascending = params.get("ascending") === "true";
  const head = ([title, isNumber, key]) => {
    if (!key) return element("th", { scope: "col", class: isNumber && "number" }, titleOf(title));
    const isIt = key === order;
    const turn = () => change({ order: key, ascending: !FALLING.includes(key) && isIt && !ascending ? "true" : "" });
    const way = isIt && (ascending && !FALLING.includes(key) ? "ascending" : "descending");
    return element("th", { scope: "col", class: isNumber && "number", "aria-sort": way },
      element("button", { type: "button", class: "sort", "data-keep": key, onclick: turn }, titleOf(title), isIt ? (ascending ? "\u00a0▲" : "\u00a0▼") : ""));
  };
  const back = () => load(pages.pop());
  const on = () => {
    pages.push(after);
    load(next);
  };
  // The version of the potential that found a candidate, if there are several: their grades cannot be compared.
  const hasVersions = candidates.some((one) => one.version != null);
  const columns = hasVersions ? [...COLUMNS, ["version", true, "version"]] : COLUMNS;
  const table = element("table", { class: "candidates" }, element("caption", { class: "unseen" }, "Candidates"),
    element("thead", {}, element("tr", {}, columns.map(head))),
    element("tbody", {}, candidates.map((candidate) => line(candidate, columns))));
  const number = pages.length + 1;
  const isGallery = params.get("view") === "pictures";
  return [
    candidates.length > 0 && (isGallery ? gallery(candidates, signal) : element("div", { class: "scrolls", role: "region", tabindex: "0", "aria-label": "Candidates" }, table)),
    sorted && element("p", { class: "quiet" }, sorted.all ? `Sorted: all ${whole(sorted.number)} that match and have a value.`
      : `Sorted: the newest ${whole(sorted.number)} that match and have a value; older ones are not read. Decision, γ₀_max and V/V₀ sort all.`),
    candidates.length === 0 && element("p", {}, "No candidate matches."),
    imported > 0 && element("p", {}, `Not listed: ${whole(imported)} imported (see calmwalk queue list).`),
    element("p", { class: "turn", role: "status" },
      element("button", { type: "button", "data-keep": "before", disabled: pages.length === 0, onclick: back }, "← previous"),
      ` page ${number} `, element("button", { type: "button", "data-keep": "next", disabled: !next, onclick: on }, "next →")),
  ].filter(Boolean);
}

function times(factor, value) {
  return value == null ? null : factor * value;
}

function perAtom(energy, { atoms }) {
  return decimals(times(1 / atoms, energy), 4);
}

function line(candidate, columns) {
  const fate = candidate.origin === "control" ? "control" : candidate.fate;
  const cells = [
    element("a", { href: `#candidate/${encodeURIComponent(candidate.id)}`, title: candidate.id }, shortName(candidate.id)),
    whole(candidate.decision), state(fate), candidate.job_state ? state(candidate.job_state) : "–",
    candidate.priority ?? "–", labelValue(candidate.value), decimals(candidate.selector_gamma, 2), decimals(candidate.gamma, 2),
    decimals(candidate.gamma_nbr, 2),
    decimals(candidate.relative_volume, 4), decimals(candidate.temperature, 0, "K"), candidate.seed_structure, candidate.formula,
    whole(candidate.atoms), perAtom(candidate.potential_energy, candidate), perAtom(candidate.energy, candidate), decimals(times(1000, candidate.errors?.energy), 2),
    decimals(candidate.errors?.force_mae, 4), decimals(candidate.errors?.max_force_error, 3), decimals(times(GPA, candidate.errors?.stress), 3),
    decimals(candidate.max_force, 3), candidate.attempts ?? "–", whole(candidate.version)];
  return element("tr", {}, columns.map(([, isNumber], k) => element("td", { class: isNumber && "number" }, cells[k])));
}
