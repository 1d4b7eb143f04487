// The campaign since its beginning, from the samples in the store.

import { fetchJson } from "./api.js";
import { DASHES, LINES } from "./colours.js";
import { whole } from "./format.js";
import { plot } from "./plot.js";

/** Time between two readings, ms. */
const INTERVAL = 15_000;
const MINUTE = 60_000;
const DAY = 1440;
/** Distances between two ticks, minutes. */
const STEPS = [1 / 60, 1 / 30, 1 / 12, 1 / 6, 1 / 4, 1 / 2, 1, 2, 5, 10, 15, 30, 60, 120, 180, 360, 720, DAY, 2 * DAY, 7 * DAY, 14 * DAY, 28 * DAY,
  56 * DAY, 168 * DAY, 365 * DAY];

/** Draws into `place` and draws again as samples come, until the page is left. */
export function overHistory(place, signal) {
  const read = async () => {
    const history = await fetchJson("/api/history", signal).catch(() => null);
    if (signal.aborted) return;
    // Do not replace what has the focus.
    if (history && !place.contains(document.activeElement)) place.replaceChildren(...drawn(history));
    setTimeout(read, INTERVAL);
  };
  return read();
}

function drawn({ samples, limits }) {
  if (samples.length === 0) return [];
  const { x, at } = timeAxis(samples);
  const line = (of) => samples.flatMap((sample, k) => {
    // Nothing ran between two runs.
    const isNewRun = k > 0 && samples[k - 1].run !== sample.run;
    return [...(isNewRun ? [[at(sample.time), null]] : []), [at(sample.time), of(sample)]];
  });
  const ends = [samples[0].time, samples.at(-1).time].map(at);
  const limit = (most, name) => (most == null ? [] : [{ name, colour: LINES[4], dash: DASHES[1], points: ends.map((time) => [time, most]) }]);
  const seconds = samples.at(-1).core_hours < 1 && !(limits.core_hours >= 1);
  const cost = seconds ? 3600 : 1;
  return [
    plot({ title: "Candidates", x, y: { title: "structures", least: 0, most: 4, ticks: whole }, lines: [
      { name: "accepted", colour: LINES[0], points: line((one) => one.accepted) },
      { name: "seen", colour: LINES[1], dash: DASHES[1], points: line((one) => one.seen) }] }),
    plot({ title: "Labels", x, y: { title: "labels", least: 0, most: 4, ticks: whole }, lines: [
      { name: "made", colour: LINES[2], points: line((one) => one.labels) },
      { name: "in the queue", colour: LINES[0], dash: DASHES[1], points: line((one) => one.queued + one.leased) },
      ...limit(limits.labels, "budget")] }),
    plot({ title: "Cost of labels", x, y: { title: seconds ? "core-seconds" : "core-hours", least: 0 }, lines: [
      { name: "spent", colour: LINES[2], points: line((one) => cost * one.core_hours) },
      ...limit(limits.core_hours == null ? null : cost * limits.core_hours, "budget")] }),
    plot({ title: "Failures", x, y: { title: "number", least: 0, most: 4, ticks: whole }, lines: [
      { name: "failed attempts", colour: LINES[1], points: line((one) => one.failed_attempts) },
      { name: "labels that failed for good", colour: LINES[3], dash: DASHES[1], points: line((one) => one.failed_jobs) }] }),
    plot({ title: "Throughput", x, y: { title: "steps/s of all walks", least: 0 },
      lines: [{ colour: LINES[0], points: line((one) => one.steps_per_second) }] }),
    plot({ title: "Versions of the mixture", x, y: { title: "version", least: 0, most: 4, ticks: whole },
      lines: [{ colour: LINES[0], points: line((one) => one.mixture_version) }] }),
  ];
}

/** One axis for all plots, in minutes since local midnight before the first sample, with ticks at round times of day. */
function timeAxis(samples) {
  const origin = new Date(samples[0].time);
  origin.setHours(0, 0, 0, 0);
  const at = (time) => (time - origin.getTime()) / MINUTE;
  const [least, most] = [at(samples[0].time), at(samples.at(-1).time)];
  const ticks = (minutes) => {
    const date = new Date(origin.getTime() + Math.round(minutes * 60) * 1000);
    const isDay = Math.abs(minutes / DAY - Math.round(minutes / DAY)) < 1e-9;
    if (isDay) return date.toLocaleDateString([], { day: "numeric", month: "short" });
    return date.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", hourCycle: "h23", ...(most - least < 5 && { second: "2-digit" }) });
  };
  return { at, x: { title: "local time", least, most, steps: STEPS, ticks } };
}
