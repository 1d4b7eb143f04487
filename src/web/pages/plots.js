// Two plots of the overview: the grades of walks since the dashboard started, and the newest candidates.

import { fetchJson, listen } from "./api.js";
import { DASHES, FATES, LINES } from "./colours.js";
import { element, words } from "./dom.js";
import { shortName, tick } from "./format.js";
import { plot } from "./plot.js";

/** Largest number of samples kept by this page. */
const MAX_SAMPLES = 2000;
/** Number of newest candidates shown. */
const NEWEST = 200;

export function overTime(place, signal) {
  let samples = [];
  let newest = [];
  let [seen, runs] = [-1, false];
  // The walks of a campaign that is stopped do not change.
  const draw = () => place.replaceChildren(...(runs && samples.length > 1 ? drawn(samples) : []), newestCandidates(newest));
  const begin = fetchJson("/api/samples", signal).then((found) => { samples = found; }).catch(() => {});
  listen(async ({ status, sample }) => {
    await begin;
    runs = status.run_active;
    if (samples.at(-1)?.time !== sample.time) samples.push(sample);
    if (samples.length > MAX_SAMPLES) samples = samples.filter((_, k) => k % 2 === 0);
    const now = status.candidates.seen + status.candidates.control;
    if (now !== seen) {
      seen = now;
      newest = await fetchJson(`/api/candidates?limit=${NEWEST}`, signal).then(ofOneVersion).catch(() => newest);
    }
    // Do not replace what has the focus.
    if (!signal.aborted && !place.contains(document.activeElement)) draw();
  }, signal);
}

function drawn(samples) {
  const last = samples.at(-1).time;
  const x = axisOfTime(last - samples[0].time);
  const at = (sample) => (sample.time - last) / x.unit;
  const line = (read) => samples.map((sample) => [at(sample), read(sample)]);
  const walks = [...new Set(samples.flatMap((sample) => Object.keys(sample.gamma)))].slice(-LINES.length * DASHES.length);
  if (walks.length === 0) return [];
  return [
    plot({ title: "Grade of walks since the dashboard started", x, y: { title: "γ_max", least: 0, most: 1 }, lines: walks.map((walk, k) => ({
      name: `walk ${walk}`, colour: LINES[k % LINES.length], dash: DASHES[Math.floor(k / LINES.length) % DASHES.length],
      points: line((sample) => sample.gamma[walk]) })) }),
  ];
}

function axisOfTime(span) {
  const [unit, name] = span > 1.5e8 ? [8.64e7, "d"] : span > 5.4e6 ? [3.6e6, "h"] : span > 9e4 ? [6e4, "min"] : [1e3, "s"];
  return { title: `time before now (${name})`, unit, least: -span / unit, most: 0, ticks: (value) => tick(Math.abs(value)) };
}

/** The candidates of the newest version of the potential on a page: γ of different versions cannot be compared. */
function ofOneVersion({ candidates, versions }) {
  return versions ? candidates.filter((_, k) => versions[k] === versions[0]) : candidates;
}

function newestCandidates(newest) {
  if (newest.length === 0) return element("p", { class: "quiet" }, "No candidate has been found yet.");
  const fate = (candidate) => (candidate.origin === "control" ? "control" : candidate.fate);
  const point = (candidate) => [candidate.relative_volume, candidate.gamma, `#candidate/${encodeURIComponent(candidate.id)}`,
    `${shortName(candidate.id)}: ${words(fate(candidate))}`];
  const marks = Object.entries(FATES).map(([name, look]) => ({ name: words(name), ...look,
    points: newest.filter((one) => fate(one) === name && one.gamma != null && one.relative_volume != null).map(point) }));
  return plot({ title: `Grade and volume of the newest ${NEWEST} candidates`, x: { title: "V/V₀" },
    y: { title: "γ₀_max", least: 0 }, marks: marks.filter((kind) => kind.points.length > 0) });
}
