//! Scratch arrays of threads.

use std::sync::{Mutex, MutexGuard, PoisonError};

use super::bonds::BondWork;
use super::layer_passes::{BackwardWork, Trace};
use super::network::Network;
use super::readout::ReadoutWork;
use super::vector::Vector;

/// Scratch arrays of one thread.
#[derive(Clone, Debug)]
pub(super) struct Scratch<V> {
    /// For each layer.
    pub bonds: Vec<BondWork<V>>,
    pub readout: ReadoutWork<V>,
    /// For one batch.
    pub tape: Vec<V>,
    pub backward: BackwardWork<V>,
    /// For atoms whose trace is not kept.
    pub trace: Trace<V>,
    /// ∂H/∂z of these.
    pub feature_cotangent: Vec<f64>,
}

impl<V: Vector> Scratch<V> {
    pub fn new(network: &Network<V>) -> Self {
        Self {
            bonds: network.layers.iter().map(BondWork::new).collect(),
            readout: ReadoutWork::default(),
            tape: Vec::new(),
            backward: BackwardWork::default(),
            trace: Trace::default(),
            feature_cotangent: Vec::new(),
        }
    }
}

/// A poisoned lock is harmless: what a panicked thread left in its arrays is never read.
pub(super) fn lock_scratch<V>(scratch: &[Mutex<Scratch<V>>], thread: usize) -> MutexGuard<'_, Scratch<V>> {
    scratch[thread].lock().unwrap_or_else(PoisonError::into_inner)
}
