// Hosts and their processes.

import { listen } from "./api.js";
import { element, renew, section, sentence, state, table } from "./dom.js";
import { ago, time } from "./format.js";

export const TITLE = "Hosts";

const COLUMNS = [["process"], ["number", true], ["state"], ["last heartbeat"], ["started"], ["pid", true],
  ["restarts", true], ["remark"]];

export function show(content, _, signal) {
  const place = element("div");
  content.append(place);
  listen(({ status }) => renew(place, ...hosts(status.processes)), signal);
}

function hosts(processes) {
  if (processes.length === 0) return [element("p", {}, "This campaign has no processes.")];
  const names = [...new Set(processes.map((process) => process.host))].sort();
  return names.map((host) => section(host, table(`Processes of ${host}`, COLUMNS,
    processes.filter((process) => process.host === host).map((process) => [
      process.kind, process.number, state(process.state), ago(process.last_seen), time(process.started), process.pid,
      process.restarts, sentence(process.remark)]))));
}
