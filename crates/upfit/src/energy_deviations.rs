//! Energies far from the others': labels with different zeros in one data set.

use serde::{Deserialize, Serialize};

use crate::energy_zero::quantile_of;

/// The standard deviation of a normal distribution in units of its median absolute deviation.
const MAD_TO_SIGMA: f64 = 1.4826;
/// Energies farther away than this many standard deviations …
const CUT: f64 = 10.0;
/// … and than this are named, eV/atom. Smaller differences are errors of the model.
const SMALL: f64 = 0.2;

/// How the labels' energies differ from the model's with the shifts of the elements.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EnergyDeviations {
    /// Median of label − model, eV/atom.
    pub median: f64,
    /// 1.4826 times the median absolute deviation from it, which is the standard deviation of a normal distribution, eV/atom.
    pub deviation: f64,
    /// Structures farther away than 10 such deviations and 0.2 eV/atom, farthest first.
    pub far: Vec<FarStructure>,
}

/// A structure whose energy is far from the others'.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FarStructure {
    /// Where it comes from, such as `data.extxyz:110`.
    pub place: String,
    /// Label − model − median, eV/atom.
    pub difference: f64,
}

impl EnergyDeviations {
    /// Of structures with their places and label − model, eV/atom.
    pub fn new(differences: &[(&str, f64)]) -> Self {
        let median = quantile_of(differences.iter().map(|(_, difference)| *difference), 0.5);
        let distances = differences.iter().map(|(_, difference)| (difference - median).abs());
        let deviation = MAD_TO_SIGMA * quantile_of(distances, 0.5);
        let limit = (CUT * deviation).max(SMALL);
        let structure = |(place, difference): &(&str, f64)| FarStructure {
            place: (*place).to_owned(),
            difference: difference - median,
        };
        let is_far = |structure: &FarStructure| structure.difference.abs() > limit;
        let mut far: Vec<_> = differences.iter().map(structure).filter(is_far).collect();
        far.sort_by(|a, b| b.difference.abs().total_cmp(&a.difference.abs()));
        Self { median, deviation, far }
    }

    /// Whether the energies of all structures vary more than errors of a model do: no zero belongs to most of them.
    pub fn is_wide(&self) -> bool {
        self.deviation > SMALL
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spread(differences: &[f64]) -> EnergyDeviations {
        let places: Vec<_> = (1..=differences.len()).map(|number| format!("a.xyz:{number}")).collect();
        let named: Vec<_> = places.iter().map(String::as_str).zip(differences.iter().copied()).collect();
        EnergyDeviations::new(&named)
    }

    #[test]
    fn structures_with_another_zero_are_named() {
        // The median of the differences is 0.01, that of their distances from it 0.01.
        let found = spread(&[0.0, 0.01, 0.02, -3.0, 0.01, 0.03, 40.0]);
        assert!(
            (found.median - 0.01).abs() < 1e-12 && (found.deviation - 0.014826).abs() < 1e-12,
            "{found:?}"
        );
        let far: Vec<_> = found.far.iter().map(|far| (far.place.as_str(), far.difference)).collect();
        let [("a.xyz:7", first), ("a.xyz:4", second)] = far[..] else { panic!("{far:?}") };
        assert!((first - 39.99).abs() < 1e-9 && (second + 3.01).abs() < 1e-9 && !found.is_wide());
    }

    #[test]
    fn errors_of_the_model_are_not_far() {
        // 0.19 is beyond 10 deviations, and less than 0.2.
        let cases: [&[f64]; 4] = [&[0.0, 0.001, -0.001, 0.19], &[0.1, -0.1, 0.05, -0.05, 0.4], &[0.0], &[]];
        for differences in cases {
            let found = spread(differences);
            assert!(found.far.is_empty() && !found.is_wide(), "{found:?}");
        }
    }

    #[test]
    fn two_zeros_of_equal_share_make_the_spread_wide() {
        let found = spread(&[0.0, 0.01, 5.0, 5.01]);
        assert!(found.is_wide() && found.far.is_empty(), "{found:?}");
    }
}
