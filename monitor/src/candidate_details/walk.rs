//! Where a candidate was found, and the distances of its atoms.

use std::collections::BTreeMap;

use atoms::{
    ElementPair, MinDistanceRule, MinDistances, NeighbourList, ShortestDistances, Structure,
    shortest_distance,
};
use serde::Serialize;
use serde_json::Value;
use store::{CandidateRef, Store, StoreError, StoredCandidate, WalkStatus};
use wire::TracePoint;

use crate::walk_trace::point_before;

/// Cutoff of the neighbour search, Å. No larger distance matters to the guards.
const NEIGHBOUR_CUTOFF: f64 = 8.0;

/// Where the candidate was found.
#[derive(Clone, Debug, Serialize)]
pub struct Discovery {
    /// Number of the walk.
    pub walk: u32,
    /// Version of the potential that drives it; 0 is that of the configuration. The energy, the forces and the grades are its own.
    pub version: u32,
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
    pub distances: GuardDistances,
    /// The last point of the walk's trace before it, in its segment.
    pub trace_point: Option<TracePoint>,
    /// Current state of the walk, with the rejections by its guard.
    pub walk_now: Option<WalkStatus>,
}

/// Shortest distances, and the limits of the selector's guard.
#[derive(Clone, Debug, Serialize)]
pub struct GuardDistances {
    /// Å. `None` if no two atoms are within 8 Å.
    pub shortest: Option<f64>,
    /// The pair of atoms at this distance.
    pub atoms: Option<[usize; 2]>,
    /// Each pair of elements with atoms within 8 Å.
    pub pairs: Vec<GuardPairDistance>,
}

/// The atoms of a pair of elements.
#[derive(Clone, Debug, Serialize)]
pub struct GuardPairDistance {
    /// The elements: `Al-O`.
    pub pair: ElementPair,
    /// Their shortest distance, Å.
    pub shortest: f64,
    /// That in the seed structure, Å.
    pub seed_structure: Option<f64>,
    /// The selector declines below this distance, Å (`guard.min_distances`), and leaves control frames out.
    pub limit: Option<f64>,
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
        let trace = store.walk_trace(id.walk).await?;
        let of_seed = seed.as_ref().and_then(|seed| shortest_distances(&seed.structure));
        Ok(Self {
            walk: id.walk.0,
            version: store.walk_versions().await?.version_of(id.walk.0),
            segment: id.segment,
            step: id.step,
            seed_structure: stored.seed_structure,
            seed_structure_name: seed.map(|seed| seed.name).unwrap_or_default(),
            temperature: view.temperature(),
            relative_volume: view.relative_volume(),
            energy: view.energy(),
            control_of: control_of.map(|walk| walk.0),
            partner,
            trace_point: point_before(&trace, id.segment, id.step).cloned(),
            distances: GuardDistances::new(&view.structure(), of_seed, rules),
            walk_now,
        })
    }
}

impl GuardDistances {
    fn new(structure: &Structure, seed_structure: Option<ShortestDistances>, rules: &Value) -> Self {
        let rule: Option<MinDistanceRule> =
            serde_json::from_value(rules["guard"]["min_distances"].clone()).ok();
        let limits = rule.zip(seed_structure.as_ref()).map(|(rule, seed)| rule.limits(seed));
        let limits: BTreeMap<_, _> = limits.iter().flat_map(MinDistances::iter).collect();
        let in_seed: BTreeMap<_, _> = seed_structure.iter().flat_map(ShortestDistances::iter).collect();
        let pair = |(pair, shortest): (ElementPair, f64)| GuardPairDistance {
            pair,
            shortest,
            seed_structure: in_seed.get(&pair).copied().filter(|d| d.is_finite()),
            limit: limits.get(&pair).copied(),
        };
        let pairs = shortest_distances(structure);
        let pairs = pairs.iter().flat_map(ShortestDistances::iter).filter(|(_, d)| d.is_finite());
        let pairs = pairs.map(pair).collect();
        let found = neighbours(structure).and_then(|list| shortest_distance(structure, &list));
        Self { shortest: found.map(|(.., r)| r), atoms: found.map(|(i, j, _)| [i, j]), pairs }
    }
}

fn shortest_distances(structure: &Structure) -> Option<ShortestDistances> {
    Some(ShortestDistances::from_neighbours(structure, &neighbours(structure)?))
}

fn neighbours(structure: &Structure) -> Option<NeighbourList> {
    let mut neighbours = NeighbourList::new(NEIGHBOUR_CUTOFF, 0.0);
    neighbours.update(structure).ok()?;
    Some(neighbours)
}
