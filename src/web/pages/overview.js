// Overview of the campaign.

import { canPause, pauseButton } from "./actions.js";
import { listen } from "./api.js";
import { element, facts, renew, section, sentence, state, table, words } from "./dom.js";
import { bytes, coreTime, counted, decimals, digits, duration, percent, shortName, time, whole } from "./format.js";
import { overHistory } from "./history.js";
import { overTime } from "./plots.js";
import { campaignState } from "./campaign_state.js";
import { versions } from "./versions.js";

export const TITLE = "Overview";

/** Largest number of labels under way shown. */
const LABELS = 10;

/** Largest number of walks shown; running ones come first. */
const WALKS = 40;

/** Largest number of elements shown of those with sampled training atoms, and of the others. */
const ELEMENTS = 4;

const WALK_COLUMNS = [["walk", true], ["seed structure"], ["origin"], ["state"], ["step", true], ["T", true], ["V/V₀", true],
  ["γ_max", true], ["γ₀_max", true], ["τ", true], ["steps/s", true], ["accepted", true], ["rejected", true]];

export function show(content, _, signal) {
  const tiles = element("div", { class: "tiles" });
  const history = element("div", { class: "plots" });
  const plots = element("div", { class: "plots" });
  const rest = element("div");
  content.append(tiles, section("History", history, plots), rest);
  overHistory(history, signal);
  overTime(plots, signal);
  let [status, changes] = [null, false];
  const draw = () => {
    tiles.replaceChildren(...summary(status));
    renew(rest,
      earlyEnds(status.ends),
      versions(status),
      section("Label queue", queue(status)),
      section("Budget and end", budget(status)),
      section("Walks", walks(status, changes && draw)));
  };
  canPause().then((can) => {
    changes = can;
    if (status) draw();
  });
  listen((update) => {
    status = update.status;
    draw();
  }, signal);
}

function tile(title, value, ...more) {
  return element("div", { class: "tile" }, element("span", { class: "title" }, title), element("strong", {}, value),
    ...more.filter(Boolean).map((line) => element("span", {}, line)));
}

function summary(status) {
  const { candidates, labels, walks, mixture_version: version, staleness, training_frames: training } = status;
  const underWay = walks.filter(isUnderWay).length;
  const declined = Object.entries(candidates.declined).filter(([, count]) => count > 0)
    .map(([reason, count]) => `${whole(count)} ${words(reason)}`).join(", ");
  const how = campaignState(status);
  const inForce = status.versions.find((one) => one.state === "in_force");
  return [
    tile("Campaign", state(how), `${status.campaign.slice(0, 8)}, ${status.mode} mode`,
      status.round > 0 ? `round ${whole(status.round)}` : "", `${bytes(status.disk.bytes)} on disk`),
    tile("Walks", walks.length === 0 ? "none yet" : underWay > 0 ? `${whole(underWay)} ${status.run_active ? "running" : "unfinished"}` : `${whole(walks.length)} ended`,
      underWay > 0 || hasEarlyEnds(status.ends) ? ended(status.ends, walks.length - underWay) : "",
      status.steps_per_second == null ? "" : `${digits(status.steps_per_second)} steps/s in all`),
    tile("Candidates", `${whole(candidates.accepted)} accepted`,
      candidates.seen === 0 ? "none seen yet" : `of ${whole(candidates.seen)} seen (${percent(share(candidates.accepted, candidates.seen))})`,
      declined && `declined: ${declined}`, candidates.control > 0 && counted(candidates.control, "control frame"),
      candidates.left_out > 0 && `${whole(candidates.left_out)} left out (could not be graded, or control frames with atoms too close)`,
      status.shared_structures > 0 && `${whole(status.shared_structures)} of them identical to structures of their biased walks`),
    tile("Labels", `${whole(labels.labelled)} made`, ["queued", "leased", "failed", "dropped", "superseded", "excluded"].filter((name) => labels[name] > 0)
      .map((name) => `${whole(labels[name])} ${name}`).join(", "),
      labels.lower_states > 0 && `lower states known of ${whole(labels.lower_states)} structures (calmwalk lower-states)`,
      status.labels_last_hour > 0 && `${whole(status.labels_last_hour)} made in the last hour`),
    (inForce || status.refit) && tile("Potential", `version ${whole(inForce?.number ?? 0)}`,
      inForce?.number > 0 && `trained on ${whole(inForce.labels)} labels`,
      status.refit && `training version ${whole(status.refit.number)}: ${status.refit.remark || words(status.refit.state)}`),
    status.device && tile(status.devices.length > 1 ? "Devices" : "Device", `${percent(status.device.busy_share)} busy`,
      `${status.device.adapter} on ${status.device.device}`,
      ...(status.devices.length > 1 ? status.devices.map(oneDevice) : []),
      `${digits(status.device.mean_batch)} structures a batch, largest ${whole(status.device.largest_batch)}`,
      `${digits(status.device.bonds_per_second)} bonds/s; calls wait ${digits(1000 * status.device.mean_wait)} ms`,
      status.device.compiled > 0 && `${digits(status.device.compiled)} s for batches of new sizes`,
      status.device.restarts > 0 && element("span", { class: "wrong" }, `${whole(status.device.restarts)} restarts of the model's program`)),
    tile("Mixture", `version ${whole(version)}`,
      training?.atoms ? `training atoms with γ > 1: ${percent(training.share_above_one)}` : walks.length > 0 && "training frames are not monitored",
      ...forgotten(training?.elements ?? []),
      training?.alarm ? element("span", { class: "wrong" }, `forgetting: above ${exceeded(training)}`) : "",
      staleness?.quantile_90 > 1 ? `walkers had the newest version in ${percent(staleness.share_of_newest)} of decisions` : ""),
  ].filter(Boolean);
}

/** One of several devices, in a line. */
function oneDevice({ device, busy_share, mean_batch, bonds_per_second }) {
  return `${device}: ${percent(busy_share)} busy, ${digits(mean_batch)} structures a batch, ${digits(bonds_per_second)} bonds/s`;
}

/** The elements that are forgotten most: by the share of their sampled atoms above 1, and without a sample by the growth of σ². */
function forgotten(elements) {
  const most = (of) => elements.filter((one) => of(one) != null).toSorted((a, b) => of(b) - of(a)).slice(0, ELEMENTS);
  const growth = (one) => `mean σ² of training atoms\u00a0×\u00a0${one.mean_square_growth.toFixed(2)}`;
  return [
    ...most((one) => one.share_above_one).map((one) => `${one.element}: ${percent(one.share_above_one)} above 1, ${growth(one)}`),
    ...most((one) => (one.share_above_one == null ? one.mean_square_growth : null)).map((one) => `${one.element}: ${growth(one)}`),
  ];
}

/** The keys whose limits the mixture exceeds. Campaigns of early versions have none. */
function exceeded({ level_of_share: share, level_of_growth: growth }) {
  return [share > 1 && "calm.forgetting_alarm", growth > 1 && "calm.max_mean_square_growth"].filter(Boolean).join(" and ") || "the limit";
}

function hasEarlyEnds(ends) {
  return ends.some((end) => end.cause != null);
}

/** Number of ended walks, with early ends. */
function ended(ends, number) {
  const early = ends.filter((end) => end.cause != null).reduce((sum, end) => sum + end.walks, 0);
  const text = `${whole(number)} ended`;
  return early === 0 ? text : element("span", {}, `${text}, `, element("span", { class: "wrong" }, `${whole(early)} of them early`));
}

/** Causes of early ends and advice. */
function earlyEnds(ends) {
  const rows = ends.filter((end) => end.cause != null).map((end) => [whole(end.walks), state(end.end),
    sentence(`walk ${end.walk}: ${end.reason}`), sentence(end.advice)]);
  return rows.length === 0 ? "" : section("Walks that ended early", table("By cause", [["walks", true], ["end"], ["such as"], ["what to change"]], rows));
}

function share(part, all) {
  return all > 0 ? part / all : null;
}

/** A value with its range, which may be too narrow to show. */
function between(value, low, high) {
  return low === value && high === value ? value : `${value} (${low} to ${high})`;
}

function queue(status) {
  const { oldest_lease: oldest, cost, failures } = status;
  const remaining = cost.queue.remaining;
  const list = facts([
    ["labels per hour", status.labels_per_hour == null ? null : digits(status.labels_per_hour, "/h")],
    ["oldest lease", oldest && `job ${oldest.job}, for ${duration(Date.now() - oldest.started)}, by ${oldest.holder}`],
    ["cost so far", coreTime(cost.core_hours)],
    ["cost of the queue", remaining && between(...[remaining.expected, remaining.low, remaining.high].map(coreTime))],
  ]);
  const making = inProgress(status.labels_in_progress);
  if (failures.length === 0) return element("div", {}, list, making);
  const columns = [["class of failure"], ["failed", true], ["labelled later", true], ["unfinished", true]];
  const rows = failures.map((failure) => [words(failure.class), failure.failed > 0 ? element("a", { href: "#candidates/order=queue&state=failed", "data-keep": `failed-${failure.class}` }, whole(failure.failed)) : "0", whole(failure.labelled), whole(failure.unfinished)]);
  return element("div", {}, list, making, table("Label failures by class", columns, rows));
}

/** Labels that are being made, the longest first. */
function inProgress(labels) {
  if (labels.length === 0) return "";
  const columns = [["candidate"], ["formula"], ["protocol"], ["attempt", true], ["time so far", true], ["expected end", true], ["labeller"]];
  return table("Labels under way", columns, labels.slice(0, LABELS).map((one) => {
    const name = one.candidate.startsWith("import-") ? one.candidate
      : element("a", { href: `#candidate/${encodeURIComponent(one.candidate)}`, title: one.candidate }, shortName(one.candidate));
    const left = one.expected_seconds == null ? null : one.started + 1000 * one.expected_seconds - Date.now();
    const end = left == null ? "unknown" : left > 0 ? `in ${duration(left)}` : "overdue";
    return [name, one.formula, one.protocol, whole(one.attempt), duration(Date.now() - one.started), end, one.holder];
  }));
}

function budget(status) {
  const { limits, used, used_up: over } = status.budget;
  const end = status.expected_end;
  const of = (what, limit, unit) => `${digits(what)}${limit == null ? "" : ` of ${digits(limit)}`}\u202f${unit}`;
  const hours = (value) => (value == null ? null : digits(value, "h"));
  return facts([
    ["labels", `${whole(used.labels)}${limits.labels == null ? "" : ` of ${whole(limits.labels)}`}`],
    ["cost of labels", limits.core_hours == null ? coreTime(used.core_hours) : of(used.core_hours, limits.core_hours, "core-hours")],
    ["running time", limits.wall_hours == null ? duration(3.6e6 * used.wall_hours) : of(used.wall_hours, limits.wall_hours, "h")],
    ["used up", over],
    // Nothing is known before the first walk, and a time only while something runs.
    ["expected end", end.time == null || !status.run_active || status.walks.length === 0 ? null : `${time(end.time)} at the latest, if nothing changes`],
    ["walks need", status.walks.length === 0 ? null : hours(end.walks_hours)],
    ["labels need", status.walks.length === 0 ? null : hours(end.labels_hours)],
  ]);
}

function stateOf(walk, isRunning) {
  if (walk.paused) return "paused";
  if (!isRunning && walk.state === "running") return "stopped";
  return walk.reference_step == null ? walk.state : "reference_run";
}

/** `changed` is called after walks were paused or resumed; false if they cannot be. */
function walks({ walks: all, run_active }, changed) {
  if (all.length === 0) return element("p", { class: "quiet" }, "No walk has begun.");
  const order = [...all].sort((a, b) => isUnderWay(b) - isUnderWay(a) || a.walk - b.walk);
  const change = (some, isPaused) => () => {
    // The next update confirms it.
    some.forEach((walk) => { walk.paused = isPaused; });
    changed();
  };
  const button = (walk) => (isUnderWay(walk) || walk.paused) && pauseButton(walk.walk, walk.paused, change([walk], !walk.paused));
  const rows = order.slice(0, WALKS).map((walk) => [
    element("a", { href: `#walk/${walk.walk}`, "data-keep": `walk-${walk.walk}` }, whole(walk.walk)), walk.seed_structure, walk.origin, sentence(state(stateOf(walk, run_active)), walk.reason && element("span", { class: "reason" }, walk.reason)),
    whole(walk.reference_step ?? walk.step), decimals(walk.temperature, 0, "K"), decimals(walk.relative_volume, 4), decimals(walk.gamma_max, 2),
    decimals(walk.gamma_max_original, 2),
    digits(walk.tau), digits(walk.steps_per_second), whole(walk.accepted), whole(walk.rejected), ...(changed ? [button(walk) || ""] : [])]);
  const more = all.length - rows.length;
  const [going, paused] = [all.filter((walk) => isUnderWay(walk) && !walk.paused), all.filter((walk) => walk.paused)];
  return element("div", {},
    changed && element("p", { class: "actions" }, going.length > 0 && pauseButton(null, false, change(going, true)),
      paused.length > 0 && pauseButton(null, true, change(paused, false))),
    table("Walks, running ones first", changed ? [...WALK_COLUMNS, ["pause"]] : WALK_COLUMNS, rows),
    more > 0 && element("p", { class: "quiet" }, `… and ${whole(more)} more (calmwalk status --all)`));
}

function isUnderWay(walk) {
  return walk.state === "running" || walk.state === "waiting";
}
