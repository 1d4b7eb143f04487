// Colours that are safe for colour-blind readers: viridis for γ, and the palette of Okabe and Ito for categories, with a darker light blue:
// each has a contrast of at least 3 on light and on dark paper.

const SCALE = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99],
  [170, 220, 50], [253, 231, 37]];

/** Line colours for light and dark backgrounds. Dashes distinguish lines of one colour. */
export const LINES = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b58900", "#2f9bd8"];
export const DASHES = ["", "6 3", "2 3"];

/** Colour and marker shape by fate. */
export const FATES = {
  accepted: { colour: "#009e73", shape: "circle" },
  covered: { colour: "#2f9bd8", shape: "square" },
  duplicate: { colour: "#b58900", shape: "diamond" },
  too_close: { colour: "#d55e00", shape: "triangle" },
  budget: { colour: "#cc79a7", shape: "cross" },
  backlog: { colour: "#0072b2", shape: "plus" },
  unlikely_to_complete: { colour: "#94703f", shape: "cross" },
  grade_too_large: { colour: "#94703f", shape: "triangle" },
  control: { colour: "#8a8f98", shape: "ring" },
};

/** The colour of a share from 0 to 1, as [r, g, b]. */
export function scale(share) {
  const place = Math.min(Math.max(Number.isFinite(share) ? share : 1, 0), 1) * (SCALE.length - 1);
  const below = Math.min(Math.floor(place), SCALE.length - 2);
  return SCALE[below].map((value, k) => Math.round(value + (place - below) * (SCALE[below + 1][k] - value)));
}

/** [r, g, b] as CSS colour, lighter (> 0) or darker (< 0). */
export function css([r, g, b], change = 0) {
  const moved = (value) => Math.round(change < 0 ? value * (1 + change) : value + (255 - value) * change);
  return `rgb(${moved(r)} ${moved(g)} ${moved(b)})`;
}
