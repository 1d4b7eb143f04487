//! Bounds of the force error by grade, in words.

use monitor::calibration::{CalibrationBin, CalibrationCoverage, CalibrationSummary, ExpectedErrors};

use crate::output::{count, decimals};

/// γ_nbr of the sentence, if the bin that ends there has a bound.
const SHOWN_GRADE: f64 = 2.0;

/// What the bounds say at one grade and how often they held, or why there are none.
pub fn sentence(summary: &CalibrationSummary) -> String {
    let Some((bin, bound, by_value)) = shown_bin(summary) else {
        return format!(
            "no bound of the force error yet: a bin of γ_nbr needs {} labelled structures with atoms in it; labelled so far: {}",
            summary.found.least_structures,
            summary.structures()
        );
    };
    let place = match (bin.up_to, bin.above) {
        (Some(edge), _) => format!("at γ_nbr = {edge}"),
        (None, Some(edge)) => format!("above γ_nbr = {edge}"),
        (None, None) => "at any γ_nbr".to_owned(),
    };
    let map = summary.map(by_value);
    let of = if by_value { ", from labels chosen by value" } else { "" };
    let level = percent(map.level);
    format!("{place}, {level} of force errors are below {bound:.2} eV/Å{of}; {}", coverage(map.coverage))
}

/// How often bounds held, and the share of the atoms without one.
pub fn coverage(coverage: Option<CalibrationCoverage>) -> String {
    let Some(CalibrationCoverage { share, structures, unbounded }) = coverage else {
        return "no label has tested that yet".to_owned();
    };
    let of = match structures {
        1 => "the last structure".to_owned(),
        _ => format!("the last {structures} structures"),
    };
    // A share that rounds to nothing is not said.
    let without = match unbounded >= 0.005 {
        true => format!(" ({} of their atoms had no bound)", percent(unbounded)),
        false => String::new(),
    };
    format!("that held for {} of the atoms of {of}{without}", percent(share))
}

/// What the force error of a candidate's worst atom was expected to be, and whether its label agrees.
pub fn expected(found: &ExpectedErrors) -> Vec<String> {
    let ExpectedErrors { level, structures, by_value, worst, held } = found;
    let atom = format!("atom {} ({}), γ_nbr {:.3}", worst.atom, worst.element, worst.gamma_nbr);
    let chosen = if *by_value { " chosen by value" } else { "" };
    let labelled = format!("{}{chosen}", count(*structures, "labelled structure"));
    let Some(bound) = worst.bound else {
        let why = match structures {
            0 => "no structure was labelled before".to_owned(),
            _ => format!("too few of {labelled} have atoms in its bin of γ_nbr"),
        };
        return vec![format!("unknown for {atom}: {why}")];
    };
    let when = if worst.error.is_some() { " before its own label" } else { "" };
    let level = percent(*level);
    let mut lines =
        vec![format!("{atom}: {level} of such errors are below {bound:.3} eV/Å, from {labelled}{when}")];
    if let Some(error) = worst.error {
        let what = if error <= bound { "held" } else { "did not hold" };
        let all = held.map_or(String::new(), |held| {
            format!("; of all atoms with a bound, {} are below theirs", percent(held))
        });
        lines.push(format!("that {what}: its error is {} eV/Å{all}", decimals(Some(error), 3)));
    }
    lines
}

/// The bin that ends at [`SHOWN_GRADE`]; else the last below it, or the first above, with a bound; and whether it is of labels by value.
fn shown_bin(summary: &CalibrationSummary) -> Option<(&CalibrationBin, f64, bool)> {
    let pooled = summary.pooled().into_iter();
    let known: Vec<_> = pooled.filter_map(|(bin, by_value)| Some((bin, bin.bound?, by_value))).collect();
    let below = known.iter().rfind(|(bin, ..)| bin.up_to.is_some_and(|edge| edge <= SHOWN_GRADE));
    below.or_else(|| known.first()).copied()
}

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

#[cfg(test)]
mod tests {
    use monitor::calibration::{AtomErrorBound, CalibrationMap};

    use super::*;

    fn bin(edges: [Option<f64>; 2], bound: Option<f64>) -> CalibrationBin {
        let [above, up_to] = edges;
        CalibrationBin {
            element: None,
            above,
            up_to,
            structures: 50,
            bound,
            mean: bound,
            level_in_force: 0.9,
            coverage: None,
            in_use: true,
        }
    }

    fn summary(bins: Vec<CalibrationBin>, coverage: Option<(f64, usize)>) -> CalibrationSummary {
        let unbounded = 0.004;
        let coverage =
            coverage.map(|(share, structures)| CalibrationCoverage { share, structures, unbounded });
        let found = CalibrationMap {
            level: 0.9,
            least_structures: 20,
            window_structures: 50,
            structures: 50,
            coverage,
            bins,
        };
        CalibrationSummary { version: 0, found, by_value: None }
    }

    #[test]
    fn a_bound_is_told_with_its_coverage() {
        let bins = || {
            vec![
                bin([None, Some(0.5)], Some(0.1)),
                bin([Some(1.5), Some(2.0)], Some(0.6)),
                bin([Some(5.0), None], Some(3.0)),
            ]
        };
        assert_eq!(
            sentence(&summary(bins(), Some((0.89, 200)))),
            "at γ_nbr = 2, 90 % of force errors are below 0.60 eV/Å; that held for 89 % of the atoms of the last 200 structures"
        );
        let mut by_value = summary(bins(), Some((0.89, 200)));
        by_value.found.bins[1].in_use = false;
        let coverage = CalibrationCoverage { share: 0.92, structures: 70, unbounded: 0.031 };
        by_value.by_value = Some(CalibrationMap {
            coverage: Some(coverage),
            bins: bins()[1..2].to_vec(),
            ..by_value.found.clone()
        });
        assert_eq!(
            sentence(&by_value),
            "at γ_nbr = 2, 90 % of force errors are below 0.60 eV/Å, from labels chosen by value; that held for 92 % of the atoms of the last \
             70 structures (3 % of their atoms had no bound)"
        );
        let untested = sentence(&summary(bins()[2..].to_vec(), None));
        assert_eq!(
            untested,
            "above γ_nbr = 5, 90 % of force errors are below 3.00 eV/Å; no label has tested that yet"
        );
        let none = sentence(&summary(vec![bin([None, Some(0.5)], None)], None));
        assert!(
            none.contains("needs 20 labelled structures") && none.ends_with("labelled so far: 50"),
            "{none}"
        );
    }

    #[test]
    fn a_candidate_is_compared_with_its_label() {
        let worst =
            AtomErrorBound { atom: 3, element: "Al", gamma_nbr: 2.5, bound: Some(0.5), error: Some(0.75) };
        let mut found =
            ExpectedErrors { level: 0.9, structures: 40, by_value: false, worst, held: Some(0.875) };
        let lines = expected(&found);
        assert!(
            lines[0].ends_with("below 0.500 eV/Å, from 40 labelled structures before its own label"),
            "{lines:?}"
        );
        assert_eq!(
            lines[1],
            "that did not hold: its error is 0.750 eV/Å; of all atoms with a bound, 88 % are below theirs"
        );
        found.by_value = true;
        assert!(expected(&found)[0].contains("from 40 labelled structures chosen by value before"));
        found.worst.error = None;
        found.held = None;
        assert_eq!(expected(&found).len(), 1);
        found.worst.bound = None;
        assert!(expected(&found)[0].starts_with("unknown for atom 3 (Al), γ_nbr 2.500: too few of 40 "));
        found.structures = 0;
        assert!(expected(&found)[0].ends_with(": no structure was labelled before"));
    }
}
