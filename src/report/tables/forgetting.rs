//! What the mixture has forgotten of the potential's training data.

use calm::forgetting::{ComponentForgetting, ElementForgetting};
use monitor::mixture_values::forgetting_by_element;
use store::records::TRAINING_FRAMES;

use super::super::report_data::ReportData;
use super::{PageTable, count, percent, real, text};

/// Every element with a changed component, those first whose mean σ² has grown most.
pub fn elements(data: &ReportData) -> PageTable {
    let caption = "Training data under the newest mixture, by element: share of the sampled atoms with γ > 1, and mean σ² of all training \
                   atoms relative to the start, from the covariances. Elements that no update has touched are as at the start.";
    let titles = [
        "element",
        "γ > 1 (%)",
        "mean σ^{2} × start",
        "changed components",
        "worst component",
        "its mean σ^{2} × start",
    ];
    let mut table = PageTable::new("forgetting", caption, &titles).whole();
    for of in forgetting(data) {
        let worst = of.worst_component();
        table.rows.push(vec![
            text(&of.element),
            percent(of.share_above_one),
            real(of.mean_square_growth, 2),
            count(of.components.len() as u64),
            text(worst.map_or("–".to_owned(), |worst| worst.component.to_string())),
            real(worst.map(|worst| worst.mean_square_growth), 2),
        ]);
    }
    table
}

/// Every changed component, those first whose mean σ² has grown most.
pub fn components(data: &ReportData) -> PageTable {
    let caption =
        "Mean σ^{2} of the training atoms of each changed component of the mixture, relative to the start.";
    let titles = ["element", "component", "mean σ^{2} × start"];
    let mut table = PageTable::new("forgetting-components", caption, &titles);
    let mut all: Vec<(String, ComponentForgetting)> = Vec::new();
    for ElementForgetting { element, components, .. } in forgetting(data) {
        all.extend(components.into_iter().map(|component| (element.clone(), component)));
    }
    all.sort_by(|a, b| b.1.mean_square_growth.total_cmp(&a.1.mean_square_growth));
    for (element, ComponentForgetting { component, mean_square_growth }) in all {
        table.rows.push(vec![text(element), count(component as u64), real(mean_square_growth, 2)]);
    }
    table
}

fn forgetting(data: &ReportData) -> Vec<ElementForgetting> {
    data.values.get(TRAINING_FRAMES).map(forgetting_by_element).unwrap_or_default()
}
