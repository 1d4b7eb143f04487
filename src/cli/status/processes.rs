//! The processes of a campaign in `calmwalk status`.

use std::io::{self, Write};

use store::{CampaignStatus, ProcessRecord, this_host, unix_milliseconds};

use super::page::StatusLayout;
use crate::output::{TextTable, count};

/// A description of what the campaign does.
pub fn state(status: &CampaignStatus) -> String {
    let number = |kind, holds: fn(&str) -> bool| {
        let processes = status.processes.iter().filter(|process| process.kind == kind);
        processes.filter(|process| holds(&process.state)).count()
    };
    let alive = |kind| number(kind, |state| state != "dead" && !is_failed(state));
    let failed = number(ProcessRecord::WALKER, is_failed);
    let busy = status.walkers_busy.map(|share| format!("; walkers {:.0} % busy", 100.0 * share));
    let busy = busy.unwrap_or_default();
    match (status.finished, alive(ProcessRecord::ORCHESTRATOR), alive(ProcessRecord::LABELLER)) {
        (true, ..) => match &status.budget.used_up {
            Some(key) => format!("finished: {key} is used up (raise it and resume with calmwalk run)"),
            None => "finished".to_owned(),
        },
        (false, 0, 0) => "not running (resume with calmwalk run)".to_owned(),
        (false, 0, labellers) => {
            format!(
                "not running, but {} at work on the queue (resume with calmwalk run)",
                count(labellers, "labeller")
            )
        }
        _ if failed > 0 => {
            let all = number(ProcessRecord::WALKER, |_| true);
            format!("running, but {failed} of {all} walkers failed{busy}")
        }
        _ => format!("running{busy}"),
    }
}

fn is_failed(state: &str) -> bool {
    state.starts_with("failed")
}

/// Writes a table of the processes; if they do not fit, those that are not running have priority.
pub fn write(out: &mut dyn Write, processes: &[ProcessRecord], page: &StatusLayout) -> io::Result<()> {
    if processes.is_empty() {
        return Ok(());
    }
    let now = unix_milliseconds();
    let mut shown: Vec<_> = processes.iter().enumerate().collect();
    if shown.len() > page.others {
        shown.sort_by_key(|(_, process)| {
            process.kind != ProcessRecord::ORCHESTRATOR && process.state == "running"
        });
        shown.truncate(page.others);
        shown.sort_by_key(|(place, _)| *place);
    }
    let mut table = TextTable::new(&["process", ">pid", "state", ">restarts", ">last seen", "remark"]);
    for (_, process) in &shown {
        table.push(line(process, now));
    }
    page.table(out, &table, shown.len(), processes.len(), "processes")
}

fn line(process: &ProcessRecord, now: i64) -> Vec<String> {
    let number = process.number.map_or(String::new(), |number| format!(" {number}"));
    vec![
        format!("{}{number}", process.kind),
        pid(process),
        process.state.replace('_', " "),
        process.restarts.to_string(),
        ago(process.silence.unwrap_or(now - process.last_seen)),
        first_line(&process.remark),
    ]
}

/// The process id, with the host if it is another one.
fn pid(process: &ProcessRecord) -> String {
    let ProcessRecord { pid, host, .. } = process;
    if host.is_empty() || *host == this_host() { pid.to_string() } else { format!("{pid}@{host}") }
}

/// The first line without control characters, which a terminal would interpret.
fn first_line(text: &str) -> String {
    let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let first: String = lines.next().unwrap_or_default().chars().filter(|c| !c.is_control()).collect();
    if lines.next().is_some() { format!("{first} …") } else { first }
}

/// A past time, given by its age in ms.
fn ago(milliseconds: i64) -> String {
    format!("{} ago", format_time(milliseconds))
}

/// The time since `time`, ms since 1970.
pub fn since(time: i64) -> String {
    format_time(unix_milliseconds() - time)
}

fn format_time(milliseconds: i64) -> String {
    let seconds = milliseconds.max(0) / 1000;
    match (seconds / 86_400, seconds / 3600 % 24, seconds / 60 % 60, seconds % 60) {
        (0, 0, 0, s) => format!("{s} s"),
        (0, 0, m, s) => format!("{m} min {s} s"),
        (0, h, m, _) => format!("{h} h {m} min"),
        (d, h, ..) => format!("{d} d {h} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn process(kind: &str, number: impl Into<Option<u32>>, state: &str) -> ProcessRecord {
        ProcessRecord {
            kind: kind.into(),
            number: number.into(),
            pid: 4711,
            state: state.into(),
            last_seen: unix_milliseconds() - 61_000,
            ..ProcessRecord::default()
        }
    }

    fn text(processes: &[ProcessRecord], all: bool) -> String {
        let mut out = Vec::new();
        let most = if all { usize::MAX } else { 20 };
        write(&mut out, processes, &StatusLayout { walks: most, others: most, few: 8, width: 120 }).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn times_have_two_units() {
        let times = [999, 61_000, 3_660_000, 90_000_000].map(ago);
        assert_eq!(times, ["0 s ago", "1 min 1 s ago", "1 h 1 min ago", "1 d 1 h ago"]);
    }

    #[test]
    fn remarks_are_shown_beside_processes() {
        let mut failed = process("walker", 3, "failed");
        failed.restarts = 5;
        failed.remark = "exit code 2: cannot read\x1b[2J the mixture\n\nsecond line\n".into();
        let text = text(&[process("orchestrator", None, "running"), failed], false);
        let expected = [
            "process        pid  state    restarts      last seen  remark",
            "orchestrator  4711  running         0  1 min 1 s ago",
            "walker 3      4711  failed          5  1 min 1 s ago  exit code 2: cannot read[2J the mixture …",
        ];
        assert_eq!(text.trim().lines().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn processes_in_trouble_have_priority() {
        let mut processes = vec![process("orchestrator", None, "running")];
        processes.extend((0..100).map(|number| process("walker", number, "running")));
        processes[90].state = "backing_off".into();
        let short = text(&processes, false);
        assert!(
            short.contains("walker 89  ") && short.contains("walker 17 ") && !short.contains("walker 18 ")
        );
        assert!(short.contains("backing off"), "{short}");
        assert!(short.starts_with("\nprocess") && short.contains("orchestrator"), "{short}");
        assert!(short.ends_with("… and 81 more processes (use --all)\n"), "{short}");
        assert_eq!(text(&processes, true).lines().count(), 103);
    }

    #[test]
    fn the_state_of_a_campaign_is_described() {
        let describe = |processes: &[ProcessRecord], finished| {
            state(&CampaignStatus { processes: processes.to_vec(), finished, ..CampaignStatus::default() })
        };
        let run = process("orchestrator", None, "running");
        let lost = process("orchestrator", None, "dead");
        let (walker, labeller) = (process("walker", 0, "running"), process("labeller", 0, "running"));
        let failed_walker = process("walker", 1, "failed");
        assert_eq!(describe(&[run.clone(), walker.clone(), labeller.clone()], false), "running");
        let some = describe(&[run.clone(), walker, failed_walker.clone()], false);
        assert_eq!(some, "running, but 1 of 2 walkers failed");
        assert_eq!(describe(&[lost.clone(), failed_walker.clone()], false), describe(&[], false));
        assert_eq!(describe(&[], false), "not running (resume with calmwalk run)");
        assert!(
            describe(&[lost, failed_walker, labeller], false)
                .starts_with("not running, but 1 labeller at work on the queue")
        );
        assert_eq!(describe(&[run], true), "finished");
    }
}
