// Draws plots as SVG: lines or points over two axes, with a description for screen readers.

import { drawing, element } from "./dom.js";
import { digits, tick } from "./format.js";

const [LEFT, BOTTOM, TOP, RIGHT] = [54, 40, 10, 12];
/** Room for the title of the vertical axis, and for each character of its numbers. */
const [TITLE, CHARACTER] = [24, 6.8];
/** Width and height of a plot. */
const SIZE = [440, 230];

const SHAPES = {
  circle: "M-3 0a3 3 0 1 0 6 0a3 3 0 1 0 -6 0", square: "M-2.6 -2.6h5.2v5.2h-5.2z", diamond: "M0 -3.6L3.6 0L0 3.6L-3.6 0z",
  triangle: "M0 -3.4L3.4 2.8H-3.4z", cross: "M-3 -3L3 3M-3 3L3 -3", plus: "M-3.4 0H3.4M0 -3.4V3.4",
  ring: "M-3 0a3 3 0 1 0 6 0a3 3 0 1 0 -6 0",
};
const HOLLOW = new Set(["cross", "plus", "ring"]);

/**
 * A plot: `title`, `size` (width and height), `role` of the drawing (`group` if its marks are links to walk through), `x` and `y` (axes: title; `ticks` formats a number; `steps`: distances of ticks; `min_atoms`, `most`: values to include; `logarithmic`), and
 * `lines` ({name, colour, dash, points: [[x, y], …]}), `bands` ({colour, points: [[x, low, high], …]}) and `marks` ({name, colour, shape,
 * points: [[x, y, href, text, colour], …]}; the colour of a point replaces that of its kind). A y of null breaks a line.
 */
export function plot({ title, size = SIZE, role = "img", x, y, lines = [], bands = [], marks = [] }) {
  const points = [...lines, ...marks].flatMap((one) => one.points).filter(([, value]) => value != null);
  const edges = bands.flatMap((band) => band.points.flatMap(([at, low, high]) => [[at, low], [at, high]]));
  const all = [...points, ...edges].filter(([a, b]) => Number.isFinite(a) && Number.isFinite(b));
  if (all.length === 0) return figure(title, [], element("p", { class: "quiet empty" }, "no data yet"));
  const [width, height] = size;
  const up = axis(y, all.map(([, value]) => value), height - BOTTOM, TOP);
  const left = Math.max(LEFT, ...up.ticks.map((value) => TITLE + CHARACTER * up.text(value).length));
  const across = axis(x, all.map(([value]) => value), left, width - RIGHT);
  const svg = drawing("svg", { viewBox: `0 0 ${width} ${height}`, role, "aria-label": described(title, x, y, lines, marks, all) },
    grid(across, up, size, left), titles(x, y, size, left),
    bands.map((band) => drawing("path", { d: area(band.points, across, up), fill: band.colour, "fill-opacity": 0.2 })),
    lines.map((line) => drawing("path", { d: path(line.points, across, up), fill: "none", stroke: line.colour, "stroke-width": 1.7,
      "stroke-dasharray": line.dash ?? "", "stroke-linejoin": "round", "stroke-linecap": "round" })),
    marks.flatMap((kind) => kind.points.flatMap((point) => mark(kind, point, across, up))));
  return figure(title, [...lines, ...marks].filter((one) => one.name), svg);
}

function figure(title, named, ...children) {
  const key = named.map((one) => element("li", {}, sample(one), one.name));
  return element("figure", {}, element("figcaption", {}, title), ...children, key.length > 1 && element("ul", { class: "key" }, key));
}

function sample({ colour, dash, shape }) {
  const drawn = shape
    ? drawing("path", { d: SHAPES[shape], transform: "translate(11 6)", ...paint(colour, shape) })
    : drawing("path", { d: "M1 6H21", stroke: colour, "stroke-width": 2, "stroke-dasharray": dash ?? "" });
  return drawing("svg", { class: "sample", viewBox: "0 0 22 12", "aria-hidden": "true" }, drawn);
}

function paint(colour, shape) {
  return HOLLOW.has(shape) ? { fill: "none", stroke: colour, "stroke-width": 1.5 } : { fill: colour, "fill-opacity": 0.75 };
}

function mark({ colour: ofKind, shape }, [x, y, href, text, ofPoint], across, up) {
  const place = { d: SHAPES[shape], transform: `translate(${across.at(x).toFixed(1)} ${up.at(y).toFixed(1)})` };
  // The ends of a scale of colours are as light or as dark as paper.
  const outline = ofPoint && drawing("path", { ...place, class: HOLLOW.has(shape) ? "outline hollow" : "outline" });
  const drawn = [outline, drawing("path", { ...place, ...paint(ofPoint ?? ofKind, shape) }, text && drawing("title", {}, text))];
  return href ? drawing("a", { href, tabindex: "-1" }, drawn) : drawn;
}

/** Maps numbers to positions between `from` and `to`, with round ticks. */
function axis({ least, most, logarithmic, steps, ticks = tick }, values, from, to) {
  let low = values.reduce((a, b) => Math.min(a, b), least ?? Infinity);
  let high = values.reduce((a, b) => Math.max(a, b), most ?? -Infinity);
  if (logarithmic) [low, high] = [Math.log10(Math.max(low, 1e-12)), Math.log10(Math.max(high, 1e-12))];
  if (high - low < 1e-9 * Math.max(Math.abs(low), Math.abs(high), 1e-300)) [low, high] = around(low, logarithmic);
  const at = (value) => {
    const place = logarithmic ? Math.log10(Math.max(value, 1e-12)) : value;
    return from + ((place - low) / (high - low)) * (to - from);
  };
  const number = Math.abs(to - from) / (steps ? 70 : 55);
  return { at, ticks: logarithmic ? roundPowers(low, high, number) : roundNumbers(low, high, number, steps), text: ticks };
}

/** Range around a single value. It keeps the sign, and starts at 0 for a value of 0. */
function around(value, logarithmic) {
  if (logarithmic) return [value - 0.5, value + 0.5];
  const part = 0.1 * Math.abs(value);
  return value === 0 ? [0, 1] : [value - part, value + part];
}

/** `steps`: the distances to choose from. */
function roundNumbers(low, high, number, steps) {
  const rough = (high - low) / Math.max(number, 2);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = (steps ?? [1, 2, 5, 10].map((factor) => factor * power)).find((candidate) => candidate >= rough) ?? rough;
  const first = Math.ceil(low / step);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, k) => (first + k) * step);
}

/** Powers of ten between 10^low and 10^high, with factors of 2 and 5 if there are few; round numbers if there are fewer than two of them. */
function roundPowers(low, high, number) {
  const factors = high - low < 2 ? [1, 2, 5] : [1];
  const powers = Array.from({ length: Math.ceil(high) - Math.floor(low) + 1 }, (_, k) => Math.floor(low) + k);
  const inside = (value) => value >= 10 ** low && value <= 10 ** high;
  const found = powers.flatMap((power) => factors.map((factor) => factor * 10 ** power)).filter(inside);
  return found.length < 2 ? roundNumbers(10 ** low, 10 ** high, number) : found;
}

function grid(across, up, [width, height], left) {
  return drawing("g", { class: "grid" },
    across.ticks.map((value) => [
      drawing("path", { d: `M${across.at(value)} ${TOP}V${height - BOTTOM}` }),
      label(across.text(value), across.at(value), left, width, height - BOTTOM + 14)]).flat(),
    up.ticks.map((value) => [
      drawing("path", { d: `M${left} ${up.at(value)}H${width - RIGHT}` }),
      drawing("text", { x: left - 6, y: up.at(value) + 3.5, "text-anchor": "end" }, up.text(value))]).flat());
}

/** The number of a tick of the horizontal axis, moved where it would be cut off or would touch a number of the vertical axis. */
function label(text, x, left, width, y) {
  const half = (CHARACTER * text.length) / 2;
  return drawing("text", { x: Math.max(left - 4 + half, Math.min(x, width - 1 - half)), y, "text-anchor": "middle" }, text);
}

function titles(x, y, [width, height], left) {
  const middle = (TOP + height - BOTTOM) / 2;
  return drawing("g", { class: "titles" },
    drawing("text", { x: (left + width - RIGHT) / 2, y: height - 6, "text-anchor": "middle" }, x.title),
    drawing("text", { x: 11, y: middle, "text-anchor": "middle", transform: `rotate(-90 11 ${middle})` }, y.title));
}

function path(points, across, up) {
  let begins = true;
  return points.map(([x, y]) => {
    if (y == null) {
      begins = true;
      return "";
    }
    const place = `${across.at(x).toFixed(1)} ${up.at(y).toFixed(1)}`;
    // A line of zero length draws an isolated point as a dot.
    const drawn = begins ? `M${place}h0` : `L${place}`;
    begins = false;
    return drawn;
  }).join("");
}

function area(points, across, up) {
  const edge = (k) => points.map((point) => [point[0], point[k]]);
  return `${path(edge(2), across, up)}${path(edge(1).reverse(), across, up).replace("M", "L")}Z`;
}

function described(title, x, y, lines, marks, all) {
  const values = all.map(([, value]) => value);
  const [low, high] = [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
  const parts = [...lines, ...marks].filter((one) => one.name && one.points.length > 0).map((one) => {
    const last = one.points.findLast(([, value]) => value != null);
    return one.shape ? `${one.points.length} ${one.name}` : `${one.name} now ${last ? digits(last[1]) : "unknown"}`;
  });
  return `${title}: ${y.title} against ${x.title}, from ${digits(low)} to ${digits(high)}. ${parts.join(", ")}`;
}
