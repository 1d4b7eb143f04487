//! The thresholds of the force error that all comparisons of grades sweep.

/// Thresholds of the force error, eV/Å, at which the ROC-AUC and the contamination of a grade are given.
pub const ERROR_THRESHOLDS: [f64; 19] =
    [0.01, 0.015, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0];

/// Those of them that tables for a terminal show, eV/Å.
pub const SHOWN_ERROR_THRESHOLDS: [f64; 4] = [0.1, 0.3, 1.0, 3.0];

/// The place of a threshold in [`ERROR_THRESHOLDS`].
pub fn threshold_place(threshold: f64) -> Option<usize> {
    ERROR_THRESHOLDS.iter().position(|other| *other == threshold)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thresholds_ascend_and_those_shown_are_among_them() {
        assert!(ERROR_THRESHOLDS.is_sorted_by(|a, b| a < b));
        assert!(SHOWN_ERROR_THRESHOLDS.iter().all(|shown| threshold_place(*shown).is_some()));
        assert_eq!((threshold_place(1.0), threshold_place(0.4)), (Some(12), None));
    }
}
