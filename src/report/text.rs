//! The page: what it says, and in which order.

use super::figures::walks;
use super::report_data::ReportData;
use super::tables::collection_rule;
use crate::page::style::grouped;
use crate::page::{self, FigureEntry, PageBlock, PageTable, Section};

/// Writes the page.
pub fn write(data: &ReportData, parts: &[FigureEntry], tables: &[PageTable]) -> String {
    let title = format!("Campaign {}", data.campaign.id);
    page::write(&title, &lead(data), sections(data, parts, tables))
}

fn sections<'a>(data: &ReportData, parts: &'a [FigureEntry], tables: &'a [PageTable]) -> Vec<Section<'a>> {
    let numbered = |name: &str| PageBlock::figure(parts, name);
    let table = |name: &str| PageBlock::table(tables, name);
    let blocks = |blocks: Vec<Option<PageBlock<'a>>>| blocks.into_iter().flatten().collect::<Vec<_>>();
    let why = collection_rule(&data.configuration).map(|rule| {
        PageBlock::Paragraph(format!(
            "A structure of a biased walk becomes a candidate when {rule}, under the walker’s mixture. The selector decides with the \
             newest mixture."
        ))
    });
    vec![
        ("Summary", blocks(vec![table("summary"), table("forgetting"), table("forgetting-components")])),
        (
            "Collected structures",
            blocks(vec![why, numbered("collection"), table("conditions"), table("seed-structures")]),
        ),
        ("Walks", (0..data.walk_traces.len()).filter_map(|number| numbered(&walks::name(number))).collect()),
        (
            "Biased against control walks",
            blocks(vec![
                table("pairs"),
                numbered("pairs"),
                table("pair-tests"),
                table("pair-counts"),
                table("comparison"),
                table("comparison-errors"),
                table("comparison-ranks"),
                table("auc-by-threshold"),
                table("elements"),
                numbered("distributions"),
                numbered("errors"),
                numbered("space"),
                numbered("features"),
            ]),
        ),
        ("The potential against labels", blocks(vec![numbered("parity")])),
        (
            "Force errors by grade",
            blocks(vec![
                numbered("grades"),
                table("correlations"),
                table("energy-offsets"),
                table("quantiles-gamma"),
                table("quantiles-gamma-nbr"),
                numbered("error-bounds"),
                table("error-bounds"),
                table("error-bounds-by-value"),
            ]),
        ),
        (
            "Versions of the potential",
            blocks(vec![
                table("versions"),
                table("version-errors"),
                numbered("errors-by-labels"),
                numbered("errors-by-cost"),
                table("version-grades"),
            ]),
        ),
        (
            "Cost, failures and unlabelled structures",
            blocks(vec![
                numbered("history"),
                numbered("cost"),
                table("failures"),
                numbered("completion"),
                table("completion-model"),
                table("completion-reliability"),
                table("unlabelled"),
            ]),
        ),
        ("Settings", blocks(vec![table("settings")])),
        ("Versions and provenance", blocks(vec![table("provenance")])),
    ]
}

fn lead(data: &ReportData) -> String {
    let candidates = &data.status.candidates;
    let (biased, control) = (&data.collections.biased, &data.collections.control);
    let version = data.collections.version.map_or(String::new(), |version| {
        format!(
            " The campaign has trained its potential anew: grades, force errors and features are those of version {version}, of the \
             structures that its own walks found, and the original mixture is the one that this version began with."
        )
    });
    format!(
        "The selector accepted {} structures of {} candidates from biased walks and collected {} frames from control walks; {} of them are \
         labelled. Unless stated otherwise, grades are those of the original mixture, with which the campaign began.{version}",
        grouped(candidates.accepted),
        grouped(candidates.seen),
        grouped(candidates.control),
        grouped(biased.labelled() + control.labelled())
    )
}
