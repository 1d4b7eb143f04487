// The table of candidates. The program sorts, filters and pages; this script shows one page.

import { fetchJson } from "./api.js";
import { FATES } from "./colours.js";
import { element, renew, state, words } from "./dom.js";
import { decimals, labelValue, shortName, whole } from "./format.js";

export const TITLE = "Candidates";

const LENGTH = 50;
const STATES = ["queued", "leased", "labelled", "failed", "dropped", "superseded"];
/** Columns: title, whether it is numeric, and the sort order of its title. */
const COLUMNS = [["candidate"], ["decision", true, "decision"], ["fate"], ["label"], ["priority", true, "queue"], ["value", true], ["γ_max", true], ["γ₀_max", true, "gamma"],
  ["γ₀_nbr", true], ["V/V₀", true, "relative_volume"], ["T", true], ["seed structure"], ["formula"], ["atoms", true], ["E (eV per atom)", true], ["F_max (eV/Å)", true], ["attempts", true]];

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
    const wait = setTimeout(() => place.setAttribute("aria-busy", "true"), 200);
    try {
      const page = await fetchPage(params, after, signal, (searched) => {
        if (mine === last) progress.textContent = `${whole(searched)} candidates searched …`;
      }, () => mine !== last);
      if (mine === last) renew(place, ...lines(page, params, change, pages, after, load));
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
  content.append(filters(params, change), progress, place);
  return load(null);
}

/** A filter with few matches takes several requests. */
async function fetchPage(params, after, signal, onProgress, isStale) {
  let [found, searched, next, imported] = [[], 0, after, null];
  do {
    const query = new URLSearchParams(params);
    query.set("limit", LENGTH - found.length);
    if (next) query.set("after", next);
    const page = await fetchJson(`/api/candidates?${query}`, signal);
    found = found.concat(page.candidates.map((one, k) => ({ ...one, version: page.versions?.[k] })));
    searched += page.scanned;
    imported = page.imported;
    next = page.next;
    if (next && found.length < LENGTH) onProgress(searched);
  } while (next && found.length < LENGTH && !isStale());
  return { candidates: found, next, imported };
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

function lines({ candidates, next, imported }, params, change, pages, after, load) {
  const order = params.get("order") || "decision";
  const ascending = params.get("ascending") === "true";
  const head = ([title, isNumber, key]) => {
    if (!key) return element("th", { scope: "col", class: isNumber && "number" }, title);
    const isIt = key === order;
    const turn = () => change({ order: key, ascending: key !== "queue" && isIt && !ascending ? "true" : "" });
    const sorted = isIt && (key === "queue" ? "descending" : ascending ? "ascending" : "descending");
    return element("th", { scope: "col", class: isNumber && "number", "aria-sort": sorted },
      element("button", { type: "button", class: "sort", "data-keep": key, onclick: turn }, title, isIt ? (ascending ? "\u00a0▲" : "\u00a0▼") : ""));
  };
  const back = () => load(pages.pop());
  const on = () => {
    pages.push(after);
    load(next);
  };
  // The version of the potential that found a candidate, if there are several: their grades cannot be compared.
  const hasVersions = candidates.some((one) => one.version != null);
  const columns = hasVersions ? [...COLUMNS, ["version", true]] : COLUMNS;
  const table = element("table", { class: "candidates" }, element("caption", { class: "unseen" }, "Candidates"),
    element("thead", {}, element("tr", {}, columns.map(head))),
    element("tbody", {}, candidates.map((candidate) => line(candidate, columns))));
  const number = pages.length + 1;
  return [
    element("div", { class: "scrolls", role: "region", tabindex: "0", "aria-label": "Candidates" }, table),
    candidates.length === 0 && element("p", {}, "No candidate matches."),
    imported > 0 && element("p", {}, `Not listed: ${whole(imported)} imported (see calmwalk queue list).`),
    element("p", { class: "turn", role: "status" },
      element("button", { type: "button", "data-keep": "before", disabled: pages.length === 0, onclick: back }, "← previous"),
      ` page ${number} `, element("button", { type: "button", "data-keep": "next", disabled: !next, onclick: on }, "next →")),
  ].filter(Boolean);
}

function line(candidate, columns) {
  const fate = candidate.origin === "control" ? "control" : candidate.fate;
  const cells = [
    element("a", { href: `#candidate/${encodeURIComponent(candidate.id)}`, title: candidate.id }, shortName(candidate.id)),
    whole(candidate.decision), state(fate), candidate.job_state ? state(candidate.job_state) : "–",
    candidate.priority ?? "–", labelValue(candidate.value), decimals(candidate.selector_gamma, 2), decimals(candidate.gamma, 2),
    decimals(candidate.gamma_nbr, 2),
    decimals(candidate.relative_volume, 4), decimals(candidate.temperature, 0, "K"), candidate.seed_structure, candidate.formula,
    whole(candidate.atoms), decimals(candidate.energy == null ? null : candidate.energy / candidate.atoms, 4), decimals(candidate.max_force, 3), candidate.attempts ?? "–", whole(candidate.version)];
  return element("tr", {}, columns.map(([, isNumber], k) => element("td", { class: isNumber && "number" }, cells[k])));
}
