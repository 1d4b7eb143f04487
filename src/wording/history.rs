//! The history of a campaign as text, for a terminal.

use monitor::history::CampaignHistory;
use store::HistorySample;

use super::cost::{core_time, wall_time};
use super::date;

/// Width of a curve, characters.
const WIDTH: usize = 40;
const BARS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// What a curve shows of a sample.
type SampleQuantity = fn(&HistorySample) -> Option<f64>;

/// Curves of the quantities over the whole time; a blank where nothing ran.
pub fn text(history: &CampaignHistory) -> String {
    let (Some(first), Some(last)) = (history.samples.first(), history.samples.last()) else {
        return "no run has recorded its history yet".to_owned();
    };
    let runs = history.runs().count();
    let span = wall_time((last.time - first.time) as f64 / 1000.0);
    let limits = &history.limits;
    let of = |number: u64, limit: Option<String>| match limit {
        Some(limit) => format!("{number} of {limit}"),
        None => number.to_string(),
    };
    let cost = match limits.core_hours {
        Some(limit) => format!("{} of {limit} core-hours", core_time(last.core_hours)),
        None => core_time(last.core_hours),
    };
    let speed = last.steps_per_second.map_or("–".to_owned(), |speed| format!("{speed:.1}"));
    let rows: [(&str, SampleQuantity, String); 8] = [
        ("accepted", |one| Some(one.accepted as f64), last.accepted.to_string()),
        (
            "labels",
            |one| Some(one.labels as f64),
            of(last.labels, limits.labels.map(|limit| limit.to_string())),
        ),
        ("cost of labels", |one| Some(one.core_hours), cost),
        (
            "label queue",
            |one| Some((one.queued + one.leased) as f64),
            (last.queued + last.leased).to_string(),
        ),
        ("failed attempts", |one| Some(one.failed_attempts as f64), last.failed_attempts.to_string()),
        ("failed labels", |one| Some(one.failed_jobs as f64), last.failed_jobs.to_string()),
        ("mixture", |one| Some(one.mixture_version as f64), format!("version {}", last.mixture_version)),
        ("steps/s", |one| one.steps_per_second, speed),
    ];
    let mut lines = vec![
        format!(
            "from {} to {}, {span}, {}",
            date::utc(first.time),
            date::utc(last.time),
            crate::output::count(runs, "run")
        ),
        String::new(),
    ];
    for (name, of, now) in rows {
        let curve = curve(history, of);
        if curve.chars().any(|bar| bar != ' ' && bar != BARS[0]) {
            lines.push(format!("{name:<16} {curve}  {now}"));
        }
    }
    lines.join("\n")
}

/// A bar for each part of the time, from 0 to the largest value.
fn curve(history: &CampaignHistory, of: SampleQuantity) -> String {
    let (Some(first), Some(last)) = (history.samples.first(), history.samples.last()) else {
        return String::new();
    };
    let part = (last.time - first.time) / WIDTH as i64 + 1;
    let largest = history.samples.iter().filter_map(of).fold(0.0, f64::max);
    let bar = |place: usize| {
        let (begin, end) = (first.time + part * place as i64, first.time + part * (place as i64 + 1));
        let value = value_at(history, begin, end, of)?;
        let level = if largest > 0.0 { (7.0 * value / largest).round() as usize } else { 0 };
        BARS.get(level).copied()
    };
    (0..WIDTH).map(|place| bar(place).unwrap_or(' ')).collect()
}

/// The last value before `end`, if a run lasted at any time from `begin` on.
fn value_at(history: &CampaignHistory, begin: i64, end: i64, of: SampleQuantity) -> Option<f64> {
    let during = |run: &&[HistorySample]| {
        run.first().is_some_and(|first| first.time < end) && run.last().is_some_and(|last| last.time >= begin)
    };
    let run = history.runs().filter(during).last()?;
    run.iter().rev().find(|sample| sample.time < end).and_then(of)
}

#[cfg(test)]
mod tests {
    use store::Budget;

    use super::*;

    #[test]
    fn curves_have_blanks_where_nothing_ran() {
        let sample = |minute: i64, run: i64| HistorySample {
            time: 60_000 * minute,
            run,
            accepted: minute as u64,
            ..HistorySample::default()
        };
        let samples: Vec<_> = (0..20).map(|k| sample(k, 0)).chain((40..=60).map(|k| sample(k, 1))).collect();
        let limits = Budget { labels: Some(10), ..Budget::default() };
        let history = CampaignHistory { samples, limits, versions: Vec::new() };
        let shown = text(&history);
        assert!(
            shown.starts_with("from 1970-01-01 00:00 UTC to 1970-01-01 01:00 UTC, 1.0 h, 2 runs\n"),
            "{shown}"
        );
        let accepted = shown.lines().find(|line| line.starts_with("accepted")).unwrap();
        let curve: Vec<char> = accepted.chars().skip(17).take(WIDTH).collect();
        assert!(curve[..12].iter().all(|bar| BARS.contains(bar)), "{accepted}");
        assert!(curve[15..26].iter().all(|bar| *bar == ' '), "{accepted}");
        assert!(curve[WIDTH - 1] == '█' && accepted.ends_with("  60"), "{accepted}");
        assert!(!shown.contains("failed"), "what never happened is left out: {shown}");
        assert!(text(&CampaignHistory::default()).contains("no run"));
    }
}
