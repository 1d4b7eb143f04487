//! Where a candidate was found, and how near its atoms are.

use atoms::{NeighbourList, Structure, shortest_distance};
use serde::Serialize;
use serde_json::Value;
use store::{CandidateRef, Store, StoreError, StoredCandidate, WalkStatus};

/// How far neighbours are looked for, Å: beyond it nothing is too near.
const REACH: f64 = 8.0;

/// Where it was found.
#[derive(Clone, Debug, Serialize)]
pub struct Found {
    /// Number of the walk.
    pub walk: u32,
    /// Piece of the walk between two returns to a checkpoint, from 0.
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
    /// Energy by the potential, without bias and ZBL, eV.
    pub energy: f64,
    /// The biased walk that this one controls, if it is a control.
    pub control_of: Option<u32>,
    /// The accepted candidate of that walk at the same step, if it is still of the same segment's steps.
    pub partner: Option<CandidateRef>,
    /// What the guards look at.
    pub distances: Distances,
    /// Where the walk stands now, with the refusals of its own guard.
    pub walk_now: Option<WalkStatus>,
}

/// The shortest distance, and what the selector's guard asks for.
#[derive(Clone, Debug, Serialize)]
pub struct Distances {
    /// Å; none without two atoms within 8 Å.
    pub shortest: Option<f64>,
    /// The pair that has it.
    pub atoms: Option<[usize; 2]>,
    /// That of the seed structure, Å.
    pub seed_structure: Option<f64>,
    /// Below this the selector declines, Å: max(`guard.least_distance`, `guard.least_distance_fraction` × that of the seed
    /// structure). Control frames are not held to it.
    pub least: Option<f64>,
}

impl Found {
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
            distances: Distances::of(&view.structure(), of_seed, rules),
            walk_now,
        })
    }
}

impl Distances {
    fn of(structure: &Structure, seed_structure: Option<f64>, rules: &Value) -> Self {
        let found = shortest(structure);
        let number = |key: &str| rules["guard"][key].as_f64();
        let limits = number("least_distance").zip(number("least_distance_fraction"));
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
    let mut neighbours = NeighbourList::new(REACH, 0.0);
    neighbours.update(structure).ok()?;
    shortest_distance(structure, &neighbours)
}
