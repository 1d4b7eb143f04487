//! The processes of a campaign in `calmwalk status`.

use std::io::{self, Write};

use store::{ProcessRecord, Status, this_host, unix_milliseconds};

use super::page::Page;
use crate::output::Table;

/// What the campaign does, in words.
pub fn state(status: &Status) -> String {
    let number = |kind, holds: fn(&str) -> bool| {
        let processes = status.processes.iter().filter(|process| process.kind == kind);
        processes.filter(|process| holds(&process.state)).count()
    };
    let living = |kind| number(kind, |state| state != "gone" && !is_given_up(state));
    let given_up = number(ProcessRecord::WALKER, is_given_up);
    match (status.finished, living(ProcessRecord::ORCHESTRATOR), living(ProcessRecord::LABELLER)) {
        (true, ..) => match &status.budget.used_up {
            Some(key) => format!("finished, since {key} is used up; raised, it lets calmwalk run go on"),
            None => "finished".to_owned(),
        },
        (false, 0, 0) => "not running; the same calmwalk run goes on with it".to_owned(),
        (false, 0, labellers) => {
            let who =
                if labellers == 1 { "1 labeller empties" } else { &format!("{labellers} labellers empty") };
            format!("not running, but {who} the queue; the same calmwalk run goes on with it")
        }
        _ if given_up > 0 => {
            let all = number(ProcessRecord::WALKER, |_| true);
            format!("running, but {given_up} of {all} walkers were given up")
        }
        _ => "running".to_owned(),
    }
}

fn is_given_up(state: &str) -> bool {
    state.starts_with("given up")
}

/// A line for each process; where there are many, those first that do not simply run.
pub fn write(out: &mut dyn Write, processes: &[ProcessRecord], page: &Page) -> io::Result<()> {
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
    let mut table = Table::new(&["process", ">pid", "state", ">restarts", ">last seen", "remark"]);
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
        process.state.clone(),
        process.restarts.to_string(),
        ago(process.silence.unwrap_or(now - process.last_seen)),
        first_line(&process.remark),
    ]
}

/// Its number, which is of use on its host only.
fn pid(process: &ProcessRecord) -> String {
    let ProcessRecord { pid, host, .. } = process;
    if host.is_empty() || *host == this_host() { pid.to_string() } else { format!("{pid}@{host}") }
}

/// What a process said may have many lines, and bytes that a terminal obeys.
fn first_line(text: &str) -> String {
    let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let first: String = lines.next().unwrap_or_default().chars().filter(|c| !c.is_control()).collect();
    if lines.next().is_some() { format!("{first} …") } else { first }
}

/// A time that has passed, given in ms.
fn ago(milliseconds: i64) -> String {
    format!("{} ago", lasting(milliseconds))
}

/// The time since then, ms since 1970.
pub fn since(time: i64) -> String {
    lasting(unix_milliseconds() - time)
}

fn lasting(milliseconds: i64) -> String {
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
        write(&mut out, processes, &Page { walks: most, others: most, few: 8, width: 120 }).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn times_have_two_units() {
        let times = [999, 61_000, 3_660_000, 90_000_000].map(ago);
        assert_eq!(times, ["0 s ago", "1 min 1 s ago", "1 h 1 min ago", "1 d 1 h ago"]);
    }

    #[test]
    fn failures_stand_beside_those_who_failed() {
        let mut failed = process("walker", 3, "given up");
        failed.restarts = 5;
        failed.remark = "exit code 2: cannot read\x1b[2J the mixture\n\nsecond line\n".into();
        let text = text(&[process("orchestrator", None, "running"), failed], false);
        let expected = [
            "process        pid  state     restarts      last seen  remark",
            "orchestrator  4711  running          0  1 min 1 s ago",
            "walker 3      4711  given up         5  1 min 1 s ago  exit code 2: cannot read[2J the mixture …",
        ];
        assert_eq!(text.trim().lines().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn of_many_processes_those_in_trouble_are_shown() {
        let mut processes = vec![process("orchestrator", None, "running")];
        processes.extend((0..100).map(|number| process("walker", number, "running")));
        processes[90].state = "pausing".into();
        let short = text(&processes, false);
        assert!(
            short.contains("walker 89  ") && short.contains("walker 17 ") && !short.contains("walker 18 ")
        );
        assert!(short.starts_with("\nprocess") && short.contains("orchestrator"), "{short}");
        assert!(short.ends_with("… and 81 more processes: --all shows them\n"), "{short}");
        assert_eq!(text(&processes, true).lines().count(), 103);
    }

    #[test]
    fn the_state_of_a_campaign_is_told_in_words() {
        let told = |processes: &[ProcessRecord], finished| {
            state(&Status { processes: processes.to_vec(), finished, ..Status::default() })
        };
        let run = process("orchestrator", None, "running");
        let lost = process("orchestrator", None, "gone");
        let (walker, labeller) = (process("walker", 0, "running"), process("labeller", 0, "running"));
        let given_up = process("walker", 1, "given up");
        assert_eq!(told(&[run.clone(), walker.clone(), labeller.clone()], false), "running");
        let some = told(&[run.clone(), walker, given_up.clone()], false);
        assert_eq!(some, "running, but 1 of 2 walkers were given up");
        assert_eq!(told(&[lost.clone(), given_up.clone()], false), told(&[], false));
        assert!(told(&[], false).starts_with("not running; the same"));
        assert!(
            told(&[lost, given_up, labeller], false)
                .starts_with("not running, but 1 labeller empties the queue;")
        );
        assert_eq!(told(&[run], true), "finished");
    }
}
