// The scale of colours beside a picture, with its name.

import { css, scale } from "./colours.js";
import { element } from "./dom.js";

const STEPS = 24;

/** A bar of colours from `low` to `high` (texts), named `title`. */
export function colourBar(title, low, high) {
  const steps = Array.from({ length: STEPS }, (_, k) => {
    const step = element("i");
    step.style.background = css(scale(k / (STEPS - 1)));
    return step;
  });
  return element("span", { class: "legend" }, title && element("span", {}, title), element("span", {}, low),
    element("span", { class: "bar", "aria-hidden": "true" }, steps), element("span", {}, high));
}

/** Named colours. */
export function colourNames(title, named) {
  const one = ([name, colour]) => {
    const sample = element("i", { class: "swatch", "aria-hidden": "true" });
    sample.style.background = colour;
    return element("span", { class: "whole" }, sample, name);
  };
  return element("span", { class: "legend" }, title && element("span", {}, title), named.map(one));
}
