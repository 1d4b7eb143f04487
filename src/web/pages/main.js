// Shows the page that the fragment of the address names.

import { connect, listen } from "./api.js";
import { element } from "./dom.js";
import * as candidate from "./candidate.js";
import * as candidates from "./candidates.js";
import * as errors from "./errors.js";
import * as hosts from "./hosts.js";
import * as map from "./map.js";
import * as mixture from "./mixture.js";
import * as overview from "./overview.js";
import * as walk from "./walk.js";
import { campaignState } from "./campaign_state.js";

/** Pages in the order of the menu, by the first word of their address. */
const PAGES = { overview, candidates, map, mixture, errors, hosts };
/** Pages of one thing, and the page of the menu that they belong to. */
const DETAILS = { candidate: { page: candidate, below: candidates }, walk: { page: walk, below: overview } };
const CONNECTIONS = { live: "● live", finished: "✓ finished", stopped: "○ stopped: no run is active", lost: "○ no connection: retrying", unreachable: "○ the database does not answer" };

let shown = new AbortController();

function show() {
  const [name, ...rest] = location.hash.slice(1).split("/").filter(Boolean);
  const page = DETAILS[name]?.page ?? PAGES[name] ?? overview;
  shown.abort();
  shown = new AbortController();
  const content = document.getElementById("content");
  content.replaceChildren(element("h1", {}, page.TITLE));
  document.title = `${page.TITLE} – calmwalk`;
  const current = DETAILS[name]?.below ?? page;
  for (const link of document.querySelectorAll("#pages a")) {
    link.toggleAttribute("data-current", PAGES[link.dataset.page] === current);
    if (PAGES[link.dataset.page] === current) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  Promise.resolve(page.show(content, rest.join("/"), shown.signal)).catch((error) => showError(content, error));
}

function showError(content, error) {
  if (error.name !== "AbortError") content.append(element("p", { class: "wrong", role: "alert" }, error.message));
}

function menu() {
  const link = ([name, page]) => element("a", { href: `#${name}`, "data-page": name }, page.TITLE);
  document.getElementById("pages").append(...Object.entries(PAGES).map(link));
}

/** Light, dark, or the system setting. */
function theme() {
  const button = document.getElementById("theme");
  const names = ["system", "light", "dark"];
  let chosen = localStorage.getItem("theme") ?? "system";
  const use = () => {
    document.documentElement.dataset.theme = chosen;
    button.textContent = `${{ system: "◐", light: "☀", dark: "☾" }[chosen]} ${chosen}`;
    button.setAttribute("aria-label", `Colours: ${chosen}; press to change`);
  };
  button.addEventListener("click", () => {
    chosen = names[(names.indexOf(chosen) + 1) % names.length];
    localStorage.setItem("theme", chosen);
    use();
    show();
  });
  use();
}

/** The connection counts as live only while a run is active. */
function connection(link, why = "", status = null) {
  const line = document.getElementById("connection");
  const what = status ? campaignState(status) : "running";
  const how = link === "live" && what !== "running" ? what : link;
  if (line.dataset.how !== how) line.textContent = CONNECTIONS[how];
  line.dataset.how = how;
  line.title = why;
}

menu();
theme();
connect(connection);
listen((update) => {
  document.title = document.title.replace(/calmwalk.*$/, `calmwalk ${update.status.name ?? update.status.campaign.slice(0, 8)}`);
}, new AbortController().signal);
// Keep the address, which names the page.
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault();
  document.getElementById("content").focus();
});
// Of what a button starts.
addEventListener("unhandledrejection", (event) => showError(document.getElementById("content"), event.reason));
addEventListener("hashchange", () => {
  show();
  document.getElementById("content").focus();
});
show();
