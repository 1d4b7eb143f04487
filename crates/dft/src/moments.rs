//! Magnetic moments that a calculation starts from.

use std::collections::{BTreeMap, BTreeSet};

use atoms::{Species, Structure};

use crate::RetryAdjustment;

/// Initial moment of each element, μ_B.
pub type Moments = BTreeMap<Species, f64>;

/// Elements that are not in the table start from this, μ_B: a calculation that starts without any moment never finds
/// one, and stretched structures of elements that are not magnetic may have some.
const DEFAULT_MOMENT: f64 = 1.0;

/// Initial moment of each atom, [n], μ_B. With [`RetryAdjustment::OtherMoments`] half of it, which is nearer to other solutions.
pub(crate) fn initial(
    structure: &Structure,
    table: &Moments,
    adjustments: &BTreeSet<RetryAdjustment>,
) -> Vec<f64> {
    let factor = if adjustments.contains(&RetryAdjustment::OtherMoments) { 0.5 } else { 1.0 };
    structure
        .species
        .iter()
        .map(|species| factor * table.get(species).copied().unwrap_or(DEFAULT_MOMENT))
        .collect()
}
