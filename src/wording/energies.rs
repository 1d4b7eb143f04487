//! Energy errors, in words.

use analysis::TooFewLabels;
use monitor::energy_errors::{EnergySummary, OffsetEntry, OffsetSummary};

use crate::output::decimals;

/// One line in meV/atom, without the offsets. `None` without errors.
pub fn errors(summary: &EnergySummary) -> Option<String> {
    let EnergySummary { structures, left_out, mean, median, p90, largest, .. } = summary;
    let milli = |x: &Option<f64>| decimals(x.map(|x| 1000.0 * x), 1);
    (*mean)?;
    let mut line = format!(
        "mean {}, median {}, 90 % below {}, largest {} meV/atom, over {structures} structures",
        milli(mean),
        milli(median),
        milli(p90),
        milli(largest),
    );
    if *left_out > 0 {
        line += &format!(" ({left_out} more have compositions with too few labels)");
    }
    Some(line)
}

/// The element offsets that energy errors exclude, or why there are none.
pub fn offsets(summary: &OffsetSummary) -> String {
    if let Some(TooFewLabels { structures, needed }) = summary.too_few {
        return format!(
            "no energy errors: fitting the element offsets between labels and the potential takes at least {needed} labelled \
             structures; there {}",
            match structures {
                1 => "is 1".to_owned(),
                n => format!("are {n}"),
            }
        );
    }
    let OffsetSummary { structures, left_out, elements, .. } = summary;
    let offset = |found: &OffsetEntry| format!("{} {:.4}", found.element, found.offset);
    let mut note = format!(
        "energy errors exclude the element offsets (eV/atom, E_label − E_model): {}; least squares over {structures} labelled \
         structures",
        elements.iter().map(offset).collect::<Vec<_>>().join(", "),
    );
    if *left_out > 0 {
        note += &format!(", without {left_out} outliers");
    }
    let together: Vec<_> =
        elements.iter().filter(|found| !found.separate).map(|found| found.element).collect();
    if !together.is_empty() {
        note += &format!(
            "; the labelled compositions do not determine the offsets of {} separately, only sums",
            together.join(", ")
        );
    }
    note
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_offsets_are_listed_with_what_limits_them() {
        let entry = |element, offset| OffsetEntry { element, offset, separate: false };
        let mut summary = OffsetSummary {
            structures: 12,
            left_out: 2,
            elements: vec![entry("O", -4.0), entry("Si", 1.25)],
            too_few: None,
        };
        let expected = "energy errors exclude the element offsets (eV/atom, E_label − E_model): O -4.0000, Si 1.2500; least squares over \
                        12 labelled structures, without 2 outliers; the labelled compositions do not determine the offsets of O, Si \
                        separately, only sums";
        assert_eq!(offsets(&summary), expected);
        summary.too_few = Some(TooFewLabels { structures: 1, needed: 3 });
        assert!(offsets(&summary).ends_with("takes at least 3 labelled structures; there is 1"));
    }
}
