//! Batches of copies of a structure, before walkers call: programs are compiled, the memory of the device becomes known, and so does
//! whether bits depend on the size of the batch.

use tracing::info;

use crate::call::BondGeometry;
use crate::description::AdapterFeatures;
use crate::events::DeviceEvent;
use crate::faults::ServerFault;
use crate::schedule::SLOTS;
use crate::self_test::{Asked, TestResult, random_numbers};
use crate::server::Synchronous;
use crate::server_loop::ServerLoop;

/// The numbers of a structure in a batch, of each of its calls.
type Copied = Vec<TestResult>;

impl ServerLoop<'_> {
    /// Evaluates batches of one, two, four … and `most` copies, and finds how many fit into the memory. Returns whether each copy has the bits of
    /// the structure alone.
    ///
    /// # Errors
    /// A server that fails twice at a batch.
    pub fn warm_up(&mut self, geometry: &BondGeometry, most: usize) -> Result<bool, String> {
        if let Some(reason) = &self.given_up {
            return Err(reason.clone());
        }
        if self.server.is_none() || !self.sent.is_empty() {
            return Err("the device was in use before it was prepared".to_owned());
        }
        let mut early = Vec::new();
        let bonds = geometry.shape().bonds;
        let (mut copies, mut fitting, mut failed_at) = (1, 1, 0);
        let (mut alone, mut outcome) = (None, Ok(true));
        loop {
            let top = most.min(self.schedule.max_structures());
            if copies > top || (copies > 1 && copies * bonds > self.schedule.max_bonds()) {
                break;
            }
            (self.progress)(&format!("preparing batches of {copies}"));
            match self.evaluate_copies(geometry, copies, &mut early) {
                Ok(results) => {
                    let first = alone.get_or_insert_with(|| results[0].clone());
                    let are_same = results.iter().all(|one| one == first);
                    outcome = outcome.map(|all| all && are_same);
                    fitting = copies;
                    // The largest batch is one of its own, whatever its number.
                    copies = if copies < top { top.min(2 * copies) } else { top + 1 };
                }
                Err(short @ (ServerFault::Memory(_) | ServerFault::Arena(_))) if copies > 1 => {
                    info!(
                        message = short.message(),
                        copies, "the memory of the device takes fewer structures"
                    );
                    self.limit_bonds(bonds * fitting, matches!(short, ServerFault::Memory(_)));
                    break;
                }
                Err(fault) => {
                    let message = fault.message().to_owned();
                    self.restart(fault, Vec::new());
                    if failed_at == copies || self.server.is_none() {
                        outcome = Err(message);
                        break;
                    }
                    failed_at = copies;
                }
            }
        }
        for event in early {
            // A device that was closed meanwhile learns so again from its channel.
            self.handle(event);
        }
        outcome
    }

    /// One batch in each slot: walkers have the device keep two evaluations at a time. Returns the results of all copies.
    fn evaluate_copies(
        &mut self,
        geometry: &BondGeometry,
        copies: usize,
        early: &mut Vec<DeviceEvent>,
    ) -> Result<Vec<Copied>, ServerFault> {
        let Some(server) = self.server.as_mut() else { return Err(ServerFault::Stopped) };
        let has_features = server.description.features.form != AdapterFeatures::None;
        let dimension = if has_features { server.description.features.dimension } else { 0 };
        let cotangent = random_numbers(geometry.positions.len() * dimension, 5);
        let structures = vec![geometry; copies];
        let cotangents = vec![&cotangent[..]; copies];
        let gradients = |with_energy, kept| Asked::Gradients { cotangents: &cotangents, with_energy, kept };
        let mut asked = vec![Asked::Forces];
        if has_features {
            asked.extend([gradients(false, true), gradients(false, false)]);
        }
        if has_features && self.setup.settings.combined_gradients {
            asked.extend([Asked::NoForces, gradients(true, true), gradients(true, false)]);
        }
        let mut all = vec![Copied::new(); SLOTS * copies];
        for slot in 0..SLOTS {
            let mut calls =
                Synchronous { server: &mut *server, setup: self.setup, early: &mut *early, fault: None };
            for asked in &asked {
                let results = calls.round_trip(slot, &structures, *asked)?;
                let of_slot = all[slot * copies..].iter_mut().zip(results);
                of_slot.for_each(|(copy, result)| copy.push(result));
            }
        }
        Ok(all)
    }
}
