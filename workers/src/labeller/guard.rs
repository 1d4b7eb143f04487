//! Guards that reject a structure before any cost is spent on its label.

mod bonds;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use analysis::{CostModel, CostPredictors, MeasuredCost};
use atoms::cell::{dot, norm};
use atoms::{ElementPair, Structure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use store::records::Lease;
use store::{Store, StoreError};

/// Metadata name under which the leader stores the campaign's guard as JSON. It applies to every labeller from the
/// next label on.
pub const GUARD: &str = "label_guard";

/// Failure class of an attempt that a guard rejected.
pub(super) const REJECTED: &str = "rejected_by_label_guard";

/// Number of structures whose features are compared: those nearest in energy.
const MAX_COMPARED: u32 = 32;
/// Number of labels used to estimate the cost.
const MAX_COST_LABELS: u32 = 1_000;

/// `[label.guard]`: limits that are not set do not apply. Shape limits ignore non-periodic directions.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LabelGuard {
    /// Minimum bond length for pairs of elements, Å.
    #[schemars(
        with = "BTreeMap<String, f64>",
        extend(
            "additionalProperties" = false,
            "patternProperties" = { "^[A-Z][a-z]?-[A-Z][a-z]?$": { "type": "number", "exclusiveMinimum": 0 } },
        )
    )]
    pub min_bond_lengths: BTreeMap<ElementPair, f64>,
    /// Minimum distance between opposite faces of the cell, Å.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub min_height: Option<f64>,
    /// Maximum ratio of the longest to the shortest edge of the cell.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub max_edge_ratio: Option<f64>,
    /// Minimum angle α between edges of the cell; angles must be between α and 180° − α, degrees.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 90))]
    pub min_angle: Option<f64>,
    /// Minimum volume per atom, Å³.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub min_volume_per_atom: Option<f64>,
    /// Maximum volume per atom, Å³.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub max_volume_per_atom: Option<f64>,
    /// Maximum number of atoms.
    pub max_atoms: Option<u32>,
    /// Rejects a structure if the features of each atom differ from those of a labelled structure by less than this
    /// fraction of their norm.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 1))]
    pub duplicate_tolerance: Option<f64>,
    /// Maximum expected cost of a label, core-seconds.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub max_cost: Option<f64>,
}

impl LabelGuard {
    /// The first key with an invalid value, with that value and the expected one.
    pub fn invalid_setting(&self) -> Option<(&'static str, String, &'static str)> {
        let positive = |x: &f64| x.is_finite() && *x > 0.0;
        if let Some((pair, bond)) = self.min_bond_lengths.iter().find(|(_, bond)| !positive(bond)) {
            return Some(("label.guard.min_bond_lengths", format!("{pair} = {bond}"), "a length above 0, Å"));
        }
        let numbers = [
            ("label.guard.min_height", self.min_height, f64::MAX),
            ("label.guard.max_edge_ratio", self.max_edge_ratio, f64::MAX),
            ("label.guard.min_angle", self.min_angle, 90.0),
            ("label.guard.min_volume_per_atom", self.min_volume_per_atom, f64::MAX),
            ("label.guard.max_volume_per_atom", self.max_volume_per_atom, f64::MAX),
            ("label.guard.duplicate_tolerance", self.duplicate_tolerance, 1.0),
            ("label.guard.max_cost", self.max_cost, f64::MAX),
        ];
        let wrong = |(key, value, most): (&'static str, Option<f64>, f64)| {
            let value = value.filter(|value| !positive(value) || *value > most)?;
            let expected = match most {
                90.0 => "an angle above 0 and at most 90°",
                1.0 => "a number above 0 and at most 1",
                _ => "a number above 0",
            };
            Some((key, value.to_string(), expected))
        };
        numbers.into_iter().find_map(wrong)
    }

    /// Why the structure itself is rejected; `None` if it may be labelled.
    pub fn rejects(&self, structure: &Structure) -> Option<String> {
        let atoms = structure.len();
        if let Some(most) = self.max_atoms.filter(|most| atoms > *most as usize) {
            return Some(format!("{atoms} atoms, where label.guard.max_atoms is {most}"));
        }
        self.rejects_shape(structure)
            .or_else(|| self.rejects_volume(structure))
            .or_else(|| bonds::too_short(structure, &self.min_bond_lengths))
    }

    fn rejects_shape(&self, structure: &Structure) -> Option<String> {
        let cell = structure.cell.completed(structure.periodic);
        let directions: Vec<_> = (0..3).filter(|k| structure.periodic[*k]).collect();
        let heights = cell.heights();
        let height = directions.iter().map(|k| heights[*k]).reduce(f64::min)?;
        if let Some(least) = self.min_height.filter(|least| height < *least) {
            return Some(format!(
                "opposite faces of its cell are {height:.3} Å apart, where label.guard.min_height is {least}"
            ));
        }
        let edges = || directions.iter().map(|k| norm(cell.0[*k]));
        let ratio = edges().reduce(f64::max)? / edges().reduce(f64::min)?;
        if let Some(largest) = self.max_edge_ratio.filter(|largest| ratio > *largest) {
            return Some(format!(
                "the longest edge of its cell is {ratio:.2} times the shortest, where label.guard.max_edge_ratio is {largest}"
            ));
        }
        let least = self.min_angle?;
        let pairs =
            directions.iter().flat_map(|i| directions.iter().filter(move |k| i < *k).map(move |k| (*i, *k)));
        let angle = |(i, k): (usize, usize)| {
            let (a, b) = (cell.0[i], cell.0[k]);
            (dot(a, b) / (norm(a) * norm(b))).clamp(-1.0, 1.0).acos().to_degrees()
        };
        let sharp = pairs.map(angle).find(|angle| angle.min(180.0 - angle) < least)?;
        Some(format!("its cell has an angle of {sharp:.1}°, where label.guard.min_angle is {least}"))
    }

    /// Applies to cells that are periodic in all three directions.
    fn rejects_volume(&self, structure: &Structure) -> Option<String> {
        if structure.periodic != [true; 3] {
            return None;
        }
        let volume = structure.cell.volume() / structure.len() as f64;
        let too =
            |key: &str, limit: f64| format!("{volume:.3} Å³ per atom, where label.guard.{key} is {limit}");
        let small = self.min_volume_per_atom.filter(|least| volume < *least);
        let large = self.max_volume_per_atom.filter(|largest| volume > *largest);
        small
            .map(|limit| too("min_volume_per_atom", limit))
            .or(large.map(|limit| too("max_volume_per_atom", limit)))
    }
}

/// Why the campaign's guard rejects a leased job; `None` if it does not, or if the user has overruled it.
pub(super) async fn rejection(
    store: &Store,
    lease: &Lease,
    size: dft::CalculationSize,
) -> Result<Option<String>, StoreError> {
    if lease.overruled {
        return Ok(None);
    }
    let Some(text) = store.metadata(GUARD).await? else { return Ok(None) };
    let guard: LabelGuard = serde_json::from_str(&text).map_err(damaged)?;
    if let Some(reason) = guard.rejects(&lease.structure) {
        return Ok(Some(reason));
    }
    if let Some(reason) = too_costly(store, lease, size, &guard).await? {
        return Ok(Some(reason));
    }
    let Some(bound) = guard.duplicate_tolerance else { return Ok(None) };
    let near = store.near_duplicates(lease, MAX_COMPARED).await?;
    let Some((own, others)) = near else { return Ok(None) };
    let like = others.iter().find(|other| is_near(&own, &other.features, lease.structure.len(), bound));
    Ok(like.map(|other| {
        format!(
            "its features differ by less than {bound} of their norm from those of {}, which has a label \
             (label.guard.duplicate_tolerance)",
            other.candidate
        )
    }))
}

fn damaged(error: serde_json::Error) -> StoreError {
    StoreError::Damaged { what: "the guard of labels".into(), reason: error.to_string() }
}

async fn too_costly(
    store: &Store,
    lease: &Lease,
    size: dft::CalculationSize,
    guard: &LabelGuard,
) -> Result<Option<String>, StoreError> {
    let Some(largest) = guard.max_cost else { return Ok(None) };
    let costs = store.label_costs(lease.protocol, MAX_COST_LABELS).await?;
    let measured: Vec<_> = costs
        .iter()
        .map(|cost| MeasuredCost {
            size: CostPredictors {
                atoms: cost.atoms.into(),
                electrons: cost.electrons.filter(|electrons| *electrons > 0.0),
                k_points: cost.k_points.unwrap_or(1).into(),
            },
            core_seconds: cost.core_seconds,
        })
        .collect();
    let electrons = Some(size.electrons).filter(|electrons| *electrons > 0.0);
    let size = CostPredictors { atoms: size.atoms as f64, electrons, k_points: size.k_points as f64 };
    // Before the first label the cost is unknown and nothing is rejected.
    let expected = CostModel::fit(&measured, None).and_then(|model| model.predict(&size));
    let too_much = expected.map(|expected| expected.core_seconds).filter(|seconds| *seconds > largest);
    Ok(too_much.map(|seconds| {
        format!(
            "its label is expected to take {seconds:.0} core-seconds, judging by {} labels, where label.guard.max_cost \
             is {largest}",
            measured.len()
        )
    }))
}

/// Whether |z − z'| < bound |z| for each atom; features [n × D] of the same atoms in the same order.
fn is_near(own: &[f64], other: &[f64], atoms: usize, bound: f64) -> bool {
    if own.is_empty() || own.len() != other.len() || !own.len().is_multiple_of(atoms) {
        return false;
    }
    let dimension = own.len() / atoms;
    own.chunks_exact(dimension).zip(other.chunks_exact(dimension)).all(|(a, b)| {
        let distance: f64 = a.iter().zip(b).map(|(x, y)| (x - y).powi(2)).sum();
        distance < bound * bound * a.iter().map(|x| x * x).sum::<f64>()
    })
}
