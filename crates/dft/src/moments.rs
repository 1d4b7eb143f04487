//! Initial magnetic moments.

use std::collections::{BTreeMap, BTreeSet};

use atoms::{Species, Structure};

use crate::RetryAdjustment;

/// Initial moment of each element, μ_B.
pub type InitialMagneticMoments = BTreeMap<Species, f64>;

/// Default moment of an element, μ_B. A calculation that starts without moments never finds any, and strained
/// structures of nonmagnetic elements may have some.
pub(crate) const DEFAULT_MOMENT: f64 = 1.0;

/// Initial moment of each atom, `[n]`, μ_B. [`RetryAdjustment::OtherMoments`] halves it, to converge to another
/// solution.
pub(crate) fn initial(
    structure: &Structure,
    table: &InitialMagneticMoments,
    adjustments: &BTreeSet<RetryAdjustment>,
) -> Vec<f64> {
    let factor = if adjustments.contains(&RetryAdjustment::OtherMoments) { 0.5 } else { 1.0 };
    structure
        .species
        .iter()
        .map(|species| factor * table.get(species).copied().unwrap_or(DEFAULT_MOMENT))
        .collect()
}

/// Number of bands for so many electrons: a fifth more than are occupied, and a few for small cells, since the highest band must be
/// empty. With the moments of the first attempt (`None`: no spin), so that every attempt has the same number.
pub(crate) fn bands(structure: &Structure, table: Option<&InitialMagneticMoments>, electrons: f64) -> u64 {
    let moments = table.map_or(Vec::new(), |table| initial(structure, table, &BTreeSet::new()));
    let moment: f64 = moments.iter().map(|moment| moment.abs()).sum();
    (0.6 * (electrons + moment)).ceil() as u64 + 4
}
