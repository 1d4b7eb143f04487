// Formats numbers with their units.

const NONE = "–";

/** With a fixed number of decimals. */
export function decimals(value, digits, unit = "") {
  if (value == null || !Number.isFinite(value)) return NONE;
  return value.toFixed(digits).replace("-", "−") + (unit && `\u202f${unit}`);
}

/** A whole number in groups of three digits. */
export function whole(value, unit = "") {
  if (value == null) return NONE;
  const text = Math.round(value).toString();
  return text.replace(/\B(?=(\d{3})+$)/g, "\u202f") + (unit && `\u202f${unit}`);
}

/** With three significant digits. */
export function digits(value, unit = "") {
  if (value == null || !Number.isFinite(value)) return NONE;
  if (value === 0) return decimals(0, 0, unit);
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(2).replace("-", "−") + (unit && `\u202f${unit}`);
  return decimals(value, size >= 100 ? 0 : size >= 10 ? 1 : size >= 1 ? 2 : 3, unit);
}

/** A cost in core-hours, below one in core-seconds. */
export function coreTime(hours) {
  return hours != null && hours < 1 ? digits(3600 * hours, "core-seconds") : digits(hours, "core-hours");
}

/** A number with its noun. */
export function counted(number, noun) {
  return `${whole(number)} ${noun}${number === 1 ? "" : "s"}`;
}

/** The value of a queued label. One that is next for its age has the largest number. */
export function labelValue(value) {
  return value > 1e300 ? "next" : digits(value);
}

/** A number with up to six significant digits; a whole one in groups of three. */
export function tick(value) {
  if (Math.abs(value) >= 1000 && Math.abs(value) < 1e6 && Number.isInteger(value)) return whole(value).replace("-", "−");
  return String(Number(value.toPrecision(6))).replace("-", "−");
}

/** The edges of a bin. */
export function range({ above, up_to: upTo }) {
  if (upTo == null) return `> ${tick(above)}`;
  return above == null ? `≤ ${tick(upTo)}` : `${tick(above)} to ${tick(upTo)}`;
}

/** A share in percent. */
export function percent(part) {
  return part == null ? NONE : `${digits(100 * part)}\u202f%`;
}

/** Bytes. */
export function bytes(value) {
  return value >= 1e9 ? digits(value / 1e9, "GB") : digits(value / 1e6, "MB");
}

/** A time, ms since 1970, in the local time zone. */
export function time(milliseconds) {
  if (milliseconds == null) return NONE;
  return new Date(milliseconds).toLocaleString([], { dateStyle: "medium", timeStyle: "medium" });
}

/** A duration in ms. */
export function duration(milliseconds) {
  const seconds = Math.max(0, milliseconds / 1000);
  if (seconds < 120) return digits(seconds, "s");
  if (seconds < 7200) return digits(seconds / 60, "min");
  return seconds < 172800 ? digits(seconds / 3600, "h") : digits(seconds / 86400, "d");
}

/** How long ago a time was. */
export function ago(milliseconds) {
  return milliseconds == null ? NONE : `${duration(Date.now() - milliseconds)} ago`;
}

/** The part of a candidate's name that is unique within its campaign. */
export function shortName(id) {
  return id.replace(/^[0-9a-f]{8}-/, "").replace(/-[0-9a-f]{16}$/, "");
}

/** A note of the program as a sentence of its own. */
export const statement = (note) => `${note.charAt(0).toUpperCase()}${note.slice(1)}.`;
