// The state of a campaign.

/** `finished`, `running`, or `stopped` if no process runs the campaign. */
export function campaignState(status) {
  return status.finished ? "finished" : status.run_active ? "running" : "stopped";
}
