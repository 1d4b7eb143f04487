//! The model of the completion of labels, and its reliability.

use monitor::completion_model::CompletionReport;

use super::{PageTable, count, real, text};

/// Coefficients. Without rows if there are too few finished labels to learn from.
pub fn coefficients(found: &CompletionReport) -> PageTable {
    let caption = format!(
        "Logistic regression of the completion of the newest labels (n = {}, {} failed) on the largest γ under the original mixture, V/V_{{0}}, the \
         shortest distance relative to the sum of covalent radii, and fractions of elements: coefficients per unit of each, with a ridge \
         penalty.{}",
        found.finished,
        found.failed,
        match found.of_all_versions {
            true =>
                " The labels are of all versions of the potential, without γ, since this one has too few.",
            false => "",
        }
    );
    let mut table = PageTable::new("completion-model", &caption, &["predictor", "coefficient"]);
    for (name, value) in &found.coefficients {
        table.rows.push(vec![text(name), real(*value, 4)]);
    }
    table
}

/// Predicted probabilities against the shares that completed.
pub fn reliability(found: &CompletionReport) -> PageTable {
    let score = |score: Option<f64>| score.map_or("–".to_owned(), |score| format!("{score:.4}"));
    let caption = format!(
        "Reliability of the predicted probability that a label completes: structures by predicted probability, the mean of it, and the \
         share that completed with its 95 % interval (Wilson). Each structure is predicted from those of other seed structures (five parts), or of other walks \
         with fewer than five seed structures. Brier score {}; \
         {} if the share that completes were predicted for all.",
        score(found.brier_score),
        score(found.brier_score_of_share)
    );
    let titles = ["predicted from", "to", "structures", "mean predicted", "completed", "from", "to"];
    let mut table = PageTable::new("completion-reliability", &caption, &titles);
    for bin in &found.reliability {
        table.rows.push(vec![
            real(bin.from, 1),
            real(bin.to, 1),
            count(bin.structures),
            real(bin.predicted, 3),
            real(bin.observed, 3),
            real(bin.low, 3),
            real(bin.high, 3),
        ]);
    }
    table
}
