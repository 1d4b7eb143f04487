// Builds elements of a page. Data of a campaign becomes text, never markup.

/** An element with attributes (`on…`: an event listener) and children (texts or elements). */
export function element(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

/** The same for SVG. */
export function drawing(name, attributes = {}, ...children) {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function fill(made, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value != null) made.setAttribute(key, value);
  }
  made.append(...children.flat().filter((child) => child != null && child !== false));
  return made;
}

/** A section with a heading. */
export function section(title, ...children) {
  return element("section", {}, element("h2", {}, title), ...children);
}

/** A list of names and values. Entries without a value are omitted. */
export function facts(pairs) {
  const shown = pairs.filter(([, value]) => value != null && value !== "" && value !== false);
  return element("dl", {}, shown.map(([name, value]) => element("div", {}, element("dt", {}, name), element("dd", {}, value))));
}

/** A table. A column is [title, whether it is numeric]. */
export function table(caption, columns, rows) {
  const head = columns.map(([title, isNumber]) => element("th", { scope: "col", class: isNumber && "number" }, titleOf(title)));
  const cell = (value, k) => element("td", { class: columns[k][1] && "number" }, value ?? "–");
  const lines = rows.map((row) => element("tr", {}, row.map(cell)));
  return element("div", { class: "scrolls", role: "region", tabindex: "0", "aria-label": caption },
    element("table", {}, element("caption", { class: "unseen" }, caption),
      element("thead", {}, element("tr", {}, head)), element("tbody", {}, lines)));
}

/** A title may wrap, but its parts in parentheses and units do not. */
export function titleOf(title) {
  return title.split(/(\([^)]*\)|eV\/Å)/).map((part) => (/^(\(|eV)/.test(part) ? element("span", { class: "whole" }, part) : part));
}

/** A sentence in a table, which may wrap. */
export function sentence(...parts) {
  return element("span", { class: "sentence" }, ...parts);
}

/** Replaces the children of a place. Restores the keyboard focus (by `data-keep` or the name of a region; the first region if the
 *  element is disabled) and the scroll positions of regions. */
export function renew(place, ...children) {
  const name = (found) => found?.dataset?.keep ?? found?.getAttribute("aria-label");
  const had = place.contains(document.activeElement) ? name(document.activeElement) : null;
  const scrolled = new Map([...place.querySelectorAll(".scrolls")].map((region) => [name(region), [region.scrollLeft, region.scrollTop]]));
  place.replaceChildren(...children);
  for (const region of place.querySelectorAll(".scrolls")) [region.scrollLeft, region.scrollTop] = scrolled.get(name(region)) ?? [0, 0];
  if (!had) return;
  const again = [...place.querySelectorAll("[data-keep], [aria-label]")].find((found) => name(found) === had);
  (again?.disabled ? place.querySelector(".scrolls") : again)?.focus({ preventScroll: true });
}

/** A word of the JSON as text. */
export function words(name) {
  return name.replaceAll("_", " ");
}

/** A state with a marker that does not rely on colour. */
export function state(name) {
  return element("span", { class: "state", "data-state": name }, words(name));
}
