// What a campaign does.

/** `finished`, `running`, or `stopped` if no process runs it. */
export function standing(status) {
  return status.finished ? "finished" : status.led ? "running" : "stopped";
}
