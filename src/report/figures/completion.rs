//! Share of structures that were labelled, by grade and by volume.

use ::figures::{Axis, AxisScale, Colour, Figure, Marker, Panel, Rectangle};
use analysis::CompletionBin;

use super::super::report_data::ReportData;
use super::super::style::{WIDTH, grouped};
use super::super::{Csv, FigureContent, csv};
use super::row;

pub fn draw(data: &ReportData) -> Result<FigureContent, String> {
    let none = "No label job is finished yet.";
    let labels = data.labels.as_ref().ok_or(none)?;
    let (by_gamma, by_expansion) = (labels.statistics.by_gamma.bins(), labels.statistics.by_expansion.bins());
    let (labelled, failed) = counts(&by_gamma);
    if labelled + failed == 0 {
        return Err(none.into());
    }
    let description = "Labelled share of structures, by grade and by volume";
    let mut figure = Figure::new("completion", description, WIDTH, 176.0);
    let mut numbers =
        Csv::new(&["panel", "above", "up_to", "labelled", "failed", "share", "share_low", "share_high"]);
    let places = row(2, [46.0, 56.0, 12.0], 22.0, 112.0);
    for ((letter, title, bins), place) in
        [('a', "γ_{0,max}", by_gamma), ('b', "V / V_{0}", by_expansion)].into_iter().zip(places)
    {
        draw_bins(&mut figure, &mut numbers, (letter, title), &bins, place);
    }
    let caption = format!(
        "Share of labelled structures among those that were labelled or failed for good, by (a) their largest γ under the original \
         mixture and (b) their volume relative to that of the seed structure. Bars, 95 % intervals (Wilson); above the axis, the number \
         of structures in the bin. {} structures are labelled and {} failed, frames of control walks included. Force errors do not \
         include failed structures.{}",
        grouped(labelled),
        grouped(failed),
        data.collections.of_version()
    );
    Ok(FigureContent { figure, caption, numbers })
}

fn counts(bins: &[CompletionBin<String>]) -> (u64, u64) {
    (bins.iter().map(|bin| bin.labelled).sum(), bins.iter().map(|bin| bin.failed.len() as u64).sum())
}

fn draw_bins(
    figure: &mut Figure,
    numbers: &mut Csv,
    (letter, title): (char, &str),
    bins: &[CompletionBin<String>],
    place: Rectangle,
) {
    // Ticks are at the edges of bins. Structures without a value come after the last bin.
    let ends = bins.iter().enumerate().filter_map(|(k, bin)| match (bin.above, bin.up_to) {
        (_, Some(end)) => Some((k as f64 + 1.0, end.to_string())),
        (None, None) => Some((k as f64 + 0.5, "unknown".to_owned())),
        _ => None,
    });
    let y = Axis::new("labelled (%)", AxisScale::Linear, 0.0, 118.0);
    let mut panel = Panel::new(place, Axis::binned(title, bins.len(), ends), y);
    for (k, bin) in bins.iter().enumerate() {
        let x = k as f64 + 0.5;
        let failed = bin.failed.len() as u64;
        if let Some((share, (low, high))) = bin.share.zip(bin.interval) {
            panel.line([[x, 100.0 * low], [x, 100.0 * high]], Colour::BLUE.line(1.2));
            for end in [low, high] {
                panel.line([[x - 0.12, 100.0 * end], [x + 0.12, 100.0 * end]], Colour::BLUE.line(1.2));
            }
            panel.dots([[x, 100.0 * share]], Marker::Disc, 2.6, Colour::BLUE, None);
        }
        let all = grouped(bin.labelled + failed);
        panel.text([x, 108.0], [0.0, 2.5], &all, ::figures::Anchor::Middle).colour = Colour::GREY;
        let (low, high) = bin.interval.unzip();
        let mut cells = vec![letter.to_string(), csv::number(bin.above), csv::number(bin.up_to)];
        cells.extend([bin.labelled.to_string(), failed.to_string()]);
        cells.extend([bin.share, low, high].map(csv::number));
        numbers.push(&cells);
    }
    panel.panel_letter(letter);
    panel.draw(figure);
}
