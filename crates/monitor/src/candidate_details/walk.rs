//! Where a candidate was found, and the distances of its atoms.

use atoms::{NeighbourList, Structure, shortest_distance};
use serde::Serialize;
use serde_json::Value;
use store::{CandidateRef, Store, StoreError, StoredCandidate, WalkStatus};

/// Cutoff of the neighbour search, Å. No larger distance matters to the guards.
const NEIGHBOUR_CUTOFF: f64 = 8.0;

/// Where the candidate was found.
#[derive(Clone, Debug, Serialize)]
pub struct Discovery {
    /// Number of the walk.
    pub walk: u32,
    /// Segment of the walk, from 0. Each rollback to a checkpoint starts a new one.
    pub segment: u32,
    /// Step, equilibration included.
    pub step: u64,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Its name.
    pub seed_structure_name: String,
    /// Kinetic temperature, K.
    pub temperature: f64,
    /// V/V₀.
    pub relative_volume: f64,
    /// The potential's energy without bias and ZBL, eV.
    pub energy: f64,
    /// The biased walk that this control walk matches. `None` for biased walks.
    pub control_of: Option<u32>,
    /// The accepted candidate of that walk at the same step, if it belongs to the steps of the same segment.
    pub partner: Option<CandidateRef>,
    /// Distances that the guards check.
    pub distances: Distances,
    /// Current state of the walk, with the refusals of its guard.
    pub walk_now: Option<WalkStatus>,
}

/// Shortest distance, and the limit of the selector's guard.
#[derive(Clone, Debug, Serialize)]
pub struct Distances {
    /// Å. `None` if no two atoms are within 8 Å.
    pub shortest: Option<f64>,
    /// The pair of atoms at this distance.
    pub atoms: Option<[usize; 2]>,
    /// Shortest distance of the seed structure, Å.
    pub seed_structure: Option<f64>,
    /// The selector declines below this distance, Å: max(`guard.min_distance`, `guard.min_distance_fraction` ×
    /// that of the seed structure). Control frames are exempt.
    pub least: Option<f64>,
}

impl Discovery {
    pub(super) async fn read(
        store: &Store,
        stored: &StoredCandidate,
        rules: &Value,
    ) -> Result<Self, StoreError> {
        let view = stored.block.view();
        let id = view.id();
        let seed = store.seed_structure(stored.seed_structure).await?;
        let (walk_now, control_of) = store.walk(id.walk).await?.unzip();
        let control_of = control_of.flatten();
        let partner = match control_of {
            Some(partner) => store.accepted_at(partner, id.step).await?,
            None => None,
        };
        let of_seed = seed.as_ref().and_then(|seed| shortest(&seed.structure)).map(|(.., r)| r);
        Ok(Self {
            walk: id.walk.0,
            segment: id.segment,
            step: id.step,
            seed_structure: stored.seed_structure,
            seed_structure_name: seed.map(|seed| seed.name).unwrap_or_default(),
            temperature: view.temperature(),
            relative_volume: view.relative_volume(),
            energy: view.energy(),
            control_of: control_of.map(|walk| walk.0),
            partner,
            distances: Distances::new(&view.structure(), of_seed, rules),
            walk_now,
        })
    }
}

impl Distances {
    fn new(structure: &Structure, seed_structure: Option<f64>, rules: &Value) -> Self {
        let found = shortest(structure);
        let number = |key: &str| rules["guard"][key].as_f64();
        let limits = number("min_distance").zip(number("min_distance_fraction"));
        Self {
            shortest: found.map(|(.., r)| r),
            atoms: found.map(|(i, j, _)| [i, j]),
            seed_structure,
            least: limits
                .map(|(least, fraction)| seed_structure.map_or(least, |r| f64::max(least, fraction * r))),
        }
    }
}

fn shortest(structure: &Structure) -> Option<(usize, usize, f64)> {
    let mut neighbours = NeighbourList::new(NEIGHBOUR_CUTOFF, 0.0);
    neighbours.update(structure).ok()?;
    shortest_distance(structure, &neighbours)
}
