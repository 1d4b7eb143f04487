//! Labels that are being made, in words.

use monitor::label_progress::LabelUnderWay;
use store::JobState;

use super::cost::wall_time;

/// Labels that are named in one line.
const NAMED: usize = 3;

/// What is made, by which protocol, for how long, and when it will be done, at the time `now`, ms since 1970.
pub fn describe(found: &LabelUnderWay, now: i64) -> String {
    let label = &found.label;
    let attempt = if label.attempt > 1 { format!(", attempt {}", label.attempt) } else { String::new() };
    let elapsed = elapsed(found, now);
    let time = match found.expected_seconds {
        Some(expected) if expected > elapsed => format!(
            "{} of about {}, done in {}",
            wall_time(elapsed),
            wall_time(expected),
            wall_time(expected - elapsed)
        ),
        Some(expected) => format!("{}, longer than the usual {}", wall_time(elapsed), wall_time(expected)),
        None => wall_time(elapsed),
    };
    format!("{} by {}{attempt}: {time}", label.formula, label.protocol)
}

/// The time so far and the expected one, for a column.
pub fn short(found: &LabelUnderWay, now: i64) -> String {
    let elapsed = wall_time(elapsed(found, now));
    found.expected_seconds.map_or(elapsed.clone(), |expected| format!("{elapsed}/{}", wall_time(expected)))
}

/// How many labels are made and left, and those under way. `jobs`: number of jobs by protocol and state.
pub fn line(running: &[LabelUnderWay], jobs: &[(String, JobState, u64)], now: i64) -> String {
    let number = |wanted: JobState| -> u64 {
        jobs.iter().filter(|(_, state, _)| *state == wanted).map(|(.., number)| number).sum()
    };
    let (made, queued) = (number(JobState::Labelled), number(JobState::Queued));
    let named: Vec<_> = running.iter().take(NAMED).map(|one| describe(one, now)).collect();
    let more = match running.len().saturating_sub(NAMED) {
        0 => String::new(),
        more => format!("; {more} more"),
    };
    format!("labels: {made} made, {queued} queued, {} under way ({}{more})", running.len(), named.join("; "))
}

fn elapsed(found: &LabelUnderWay, now: i64) -> f64 {
    (now - found.label.started).max(0) as f64 / 1000.0
}

#[cfg(test)]
mod tests {
    use store::RunningLabel;

    use super::*;

    fn progress(expected_seconds: Option<f64>) -> LabelUnderWay {
        let label = RunningLabel {
            job: 1,
            candidate: "07070707-1.0.5-0123456789abcdef".into(),
            protocol: "abinit".into(),
            seed_structure: 0,
            formula: "Si8".into(),
            atoms: 8,
            attempt: 1,
            holder: "node/1".into(),
            started: 0,
            cores: Some(4),
        };
        LabelUnderWay { label, expected_seconds }
    }

    #[test]
    fn labels_under_way_have_their_expected_end() {
        let text = |expected| describe(&progress(expected), 192_000);
        assert_eq!(text(Some(600.0)), "Si8 by abinit: 3.2 min of about 10 min, done in 6.8 min");
        assert_eq!(text(Some(60.0)), "Si8 by abinit: 3.2 min, longer than the usual 1.0 min");
        assert_eq!(text(None), "Si8 by abinit: 3.2 min");
        assert_eq!(
            (short(&progress(Some(600.0)), 192_000), short(&progress(None), 1000)),
            ("3.2 min/10 min".into(), "1.0 s".into())
        );
        let jobs = [("abinit".into(), JobState::Labelled, 7), ("abinit".into(), JobState::Queued, 2)];
        let five: [LabelUnderWay; 5] = std::array::from_fn(|_| progress(None));
        let shown = line(&five, &jobs, 1000);
        assert!(
            shown.starts_with("labels: 7 made, 2 queued, 5 under way (Si8 by abinit: 1.0 s; "),
            "{shown}"
        );
        assert!(shown.ends_with("; 2 more)"), "{shown}");
    }
}
