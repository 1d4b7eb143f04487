//! The state of a walk between assignments.

use atoms::MinDistances;
use md::{Checkpoint, Dynamics};
use serde::{Deserialize, Serialize};

use crate::bias::{BiasState, BiasedPotential};
use crate::cell_bias::CellBias;
use crate::settings::WalkSettings;
use crate::walk::error::WalkError;

/// What a checkpoint begins with. Its bytes have no names of fields, so that those of another layout would be misread: give this another number
/// whenever a type in [`WalkState`] changes.
const LAYOUT: &[u8] = b"calmwalk walk 2\n";

/// Whether this version of calmwalk can read a checkpoint.
pub fn has_known_layout(checkpoint: &[u8]) -> bool {
    checkpoint.starts_with(LAYOUT)
}

/// Whether two checkpoints are of the same state, however many points the traces of their walks have; `None` if one of them cannot be read.
pub fn is_same_state(a: &[u8], b: &[u8]) -> Option<bool> {
    let [a, b] = [a, b].map(|checkpoint| {
        let state = WalkState::decode(checkpoint).ok()?;
        Some(WalkState { trace_points: 0, ..state }.encode())
    });
    Some(a? == b?)
}

/// Number of checkpoints kept for roll backs. The oldest one is used, so that a roll back leads out of the trap.
const MAX_CHECKPOINTS: usize = 2;

/// The checkpoint of a walk.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct WalkState {
    pub dynamics: Checkpoint,
    pub bias: BiasState,
    /// As long as it lasts; its dynamics are those of the walk.
    pub reference_run: Option<ReferenceRun>,
    /// V₀, Å³ (Å² for a slab, Å for a wire).
    pub reference_volume: f64,
    /// Of a walk with a biased cell.
    pub cell_bias: Option<CellBias>,
    /// Where the bias acts: version of the mixture, and Σγ under it.
    pub bias_sum: Option<(u64, f64)>,
    pub tau: f64,
    pub segment: u32,
    pub rollbacks: u32,
    /// Steps from which and to which the walk last rolled back.
    pub last_rollback: Option<(u64, u64)>,
    pub rejected: u64,
    pub max_consecutive_rejections: u32,
    /// First step at which a candidate may be offered.
    pub next_offer: u64,
    /// Number of collected structures.
    pub collected: u64,
    /// The points of collections that a roll back could still count from.
    pub collection_points: Vec<CollectionPoint>,
    /// How close atoms may come.
    pub min_distances: MinDistances,
    /// Targets of roll backs, oldest first.
    pub good: Vec<GoodState>,
    pub gamma_max: f64,
    /// Number of points of the trace so far.
    pub trace_points: u64,
}

/// An unbiased run at constant pressure before the first step of a walk. V₀ is its mean volume over the second half, and
/// its last structure, scaled, is that from which the walk starts (paper, Methods).
///
/// It depends on seed structure, temperature and pressure only, so walks that differ otherwise have the same V₀.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct ReferenceRun {
    /// Sum of the volumes after the steps of the second half.
    pub volumes: f64,
    /// Number of the assignment that last worked on it.
    pub assignment: u64,
    /// The step of the run at which that assignment ends, however often it is interrupted.
    pub until: u64,
}

/// A state to which a walk can roll back.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct GoodState {
    pub dynamics: Checkpoint,
    pub bias: BiasState,
    pub cell_bias: Option<CellBias>,
}

/// A collection, as seen from the current path of the walk: it lies `beyond` steps off the path, which it left at
/// step `branch`.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct CollectionPoint {
    pub branch: u64,
    pub beyond: u64,
}

impl WalkState {
    /// The bytes of a checkpoint.
    pub fn encode(&self) -> Vec<u8> {
        postcard::to_extend(self, LAYOUT.to_vec()).expect("plain data is encoded into memory")
    }

    /// Reads a checkpoint.
    pub fn decode(checkpoint: &[u8]) -> Result<Self, WalkError> {
        let content = checkpoint.strip_prefix(LAYOUT).ok_or(WalkError::CheckpointLayout)?;
        Ok(postcard::from_bytes(content)?)
    }

    /// Keeps the current state as a target of roll backs.
    pub fn keep_checkpoint(&mut self, dynamics: &Dynamics, potential: &BiasedPotential) {
        if self.good.len() == MAX_CHECKPOINTS {
            self.good.remove(0);
        }
        self.good.push(self.good_state(dynamics, potential));
    }

    /// The current state as a target of roll backs.
    pub fn good_state(&self, dynamics: &Dynamics, potential: &BiasedPotential) -> GoodState {
        let cell_bias = self.cell_bias.clone();
        GoodState { dynamics: dynamics.checkpoint().clone(), bias: potential.state, cell_bias }
    }

    /// Counts a structure that was collected at `step`, and forgets the points that no roll back can count from: those whose
    /// interval is over at the oldest target of roll backs, which never becomes older.
    pub fn collect(&mut self, step: u64, settings: &WalkSettings) {
        self.collected += 1;
        let oldest = self.good.first().map_or(0, |good| good.dynamics.state.step);
        self.collection_points.retain(|point| point.next_offer(settings) > oldest);
        self.collection_points.push(CollectionPoint { branch: step, beyond: 0 });
    }

    /// The first step at which a candidate may be offered after a roll back to `step`. The interval to a collection
    /// counts along the path that joins the two: back from the collection along the abandoned piece, then forward
    /// again.
    pub fn offer_after_rollback(&mut self, step: u64, settings: &WalkSettings) -> u64 {
        for point in self.collection_points.iter_mut().filter(|point| point.branch > step) {
            point.beyond += point.branch - step;
            point.branch = step;
        }
        let offers = self.collection_points.iter().map(|point| point.next_offer(settings));
        offers.max().unwrap_or(0).max(step + settings.min_interval_after_decline)
    }
}

impl CollectionPoint {
    /// The step of the current path at which the interval to this collection is over.
    fn next_offer(&self, settings: &WalkSettings) -> u64 {
        self.branch + settings.min_interval.saturating_sub(self.beyond)
    }
}
