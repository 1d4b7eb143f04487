//! Fates of candidates, and the rate at which new structures were found.

use ::figures::{Anchor, Axis, AxisScale, Colour, Figure, Panel};
use store::Candidates;

use super::super::report_data::ReportData;
use super::super::style::{WIDTH, grouped};
use super::super::{Csv, FigureContent, csv};
use super::row;

pub fn draw(data: &ReportData) -> Result<FigureContent, String> {
    let candidates = &data.status.candidates;
    if candidates.seen == 0 {
        return Err("No candidate has reached the selector yet.".into());
    }
    let description = "Candidates by fate, and accepted structures against candidates";
    let mut figure = Figure::new("collection", description, WIDTH, 190.0);
    let mut numbers = Csv::new(&["panel", "fate", "candidates", "accepted"]);
    let places = row(2, [86.0, 74.0, 14.0], 22.0, 128.0);
    draw_fates(&mut figure, &mut numbers, places[0], candidates);
    draw_progress(&mut figure, &mut numbers, places[1], data);
    let caption = format!(
        "Candidates of biased walks (n = {}). a, By decision of the selector: accepted, or declined because the newest mixture \
         covered them (another walk had found a similar structure), as duplicates, because atoms were too close, because \
         the quota was reached (budget), because too many labels were queued (backlog), or because their labels would probably \
         fail (unlikely to complete), or because they were beyond guard.max_grade (grade too large). The walkers’ guards rejected {} more \
         structures before they became candidates. b, Accepted structures against candidates in the order of the decisions; \
         dashed, every candidate accepted. The flatter the line, the fewer new structures the walks find.",
        grouped(candidates.seen),
        grouped(candidates.rejected_by_guards),
    );
    Ok(FigureContent { figure, caption, numbers })
}

fn draw_fates(figure: &mut Figure, numbers: &mut Csv, place: ::figures::Rectangle, candidates: &Candidates) {
    let declined = &candidates.declined;
    let mut fates = vec![
        ("backlog", declined.backlog),
        ("budget", declined.budget),
        ("too close", declined.too_close),
        ("duplicate", declined.duplicate),
        ("covered", declined.covered),
        ("accepted", candidates.accepted),
    ];
    if declined.unlikely_to_complete > 0 {
        fates.insert(0, ("unlikely to complete", declined.unlikely_to_complete));
    }
    if declined.grade_too_large > 0 {
        fates.insert(0, ("grade too large", declined.grade_too_large));
    }
    let names: Vec<_> = fates.iter().map(|(name, _)| (*name).to_owned()).collect();
    let largest = fates.iter().map(|(_, count)| *count).max().unwrap_or(0).max(1) as f64;
    let x = Axis::new("candidates", AxisScale::Linear, 0.0, 1.25 * largest).with_ticks(4);
    let mut panel = Panel::new(place, x, Axis::categorical("", &names));
    for (k, (name, count)) in fates.iter().enumerate() {
        let (low, high) = (k as f64 + 0.18, k as f64 + 0.82);
        let colour = if *name == "accepted" { Colour::VERMILLION } else { Colour::GREY };
        panel.bar([0.0, low], [*count as f64, high], colour.faint(0.75));
        panel.text([*count as f64, k as f64 + 0.5], [4.0, 2.5], &grouped(*count), Anchor::Start);
        numbers.push(&["a".to_owned(), (*name).to_owned(), count.to_string(), String::new()]);
    }
    panel.panel_letter('a');
    panel.draw(figure);
}

fn draw_progress(figure: &mut Figure, numbers: &mut Csv, place: ::figures::Rectangle, data: &ReportData) {
    let (mut seen, mut accepted) = (0, 0);
    let mut line = vec![[0.0, 0.0]];
    for part in data.fates.chunk_by(|a, b| a.part == b.part) {
        seen += part.iter().map(|fate| fate.number).sum::<u64>();
        accepted += part.iter().filter(|fate| fate.fate == "accepted").map(|fate| fate.number).sum::<u64>();
        line.push([seen as f64, accepted as f64]);
        let cells = ["b".to_owned(), String::new(), csv::number(seen as f64), csv::number(accepted as f64)];
        numbers.push(&cells);
    }
    let x = Axis::new("candidates decided", AxisScale::Linear, 0.0, 1.03 * seen.max(1) as f64).with_ticks(4);
    let y =
        Axis::new("accepted structures", AxisScale::Linear, 0.0, 1.12 * accepted.max(1) as f64).with_ticks(4);
    let mut panel = Panel::new(place, x, y);
    panel.line([[0.0, 0.0], [seen as f64, seen as f64]], Colour::GREY.dashed(0.7));
    panel.line(line, Colour::VERMILLION.line(1.5));
    panel.panel_letter('b');
    panel.draw(figure);
}
