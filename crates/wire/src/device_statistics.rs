//! What a device that evaluates a model in Python has done, as the store keeps it.

use serde::{Deserialize, Serialize};

/// Sums since the start.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct DeviceStatistics {
    /// The adapter of the model.
    pub adapter: String,
    /// Where it is evaluated.
    pub device: String,
    /// Batches that were answered.
    pub batches: u64,
    /// Structures in them, without padding.
    pub structures: u64,
    /// Directed bonds in them, without padding.
    pub bonds: u64,
    /// Time for which the server had at least one batch, s.
    pub busy: f64,
    /// Time that the adapter itself took, s.
    pub computed: f64,
    /// Time for which calls waited until their batch was sent, s.
    pub waited: f64,
    /// Time of batches of a shape that was new, s: frameworks compile for it.
    pub compiled: f64,
    /// Time since the start, s.
    pub elapsed: f64,
    /// Starts of the server after the first one.
    pub restarts: u64,
    /// Largest batch, structures.
    pub largest_batch: u64,
    /// Bonds to which batches of several structures are limited, because the memory of the device was short.
    pub max_bonds: Option<u64>,
    /// The last failure.
    pub last_failure: Option<String>,
}

impl DeviceStatistics {
    /// What several devices of a host have done together; `None` without any. Times are sums over the devices.
    pub fn total(devices: &[Self]) -> Option<Self> {
        let (first, others) = devices.split_first()?;
        let mut total = first.clone();
        for one in others {
            total.device = format!("{}, {}", total.device, one.device);
            total.batches += one.batches;
            total.structures += one.structures;
            total.bonds += one.bonds;
            total.busy += one.busy;
            total.computed += one.computed;
            total.waited += one.waited;
            total.compiled += one.compiled;
            total.elapsed += one.elapsed;
            total.restarts += one.restarts;
            total.largest_batch = total.largest_batch.max(one.largest_batch);
            total.max_bonds = total.max_bonds.into_iter().chain(one.max_bonds).min();
            total.last_failure = total.last_failure.or_else(|| one.last_failure.clone());
        }
        Some(total)
    }

    /// Share of the time for which the server had work.
    pub fn busy_share(&self) -> f64 {
        if self.elapsed > 0.0 { self.busy / self.elapsed } else { 0.0 }
    }

    /// Mean number of structures of a batch.
    pub fn mean_batch(&self) -> f64 {
        if self.batches > 0 { self.structures as f64 / self.batches as f64 } else { 0.0 }
    }

    /// Directed bonds a second of the server's work.
    pub fn bonds_per_second(&self) -> f64 {
        if self.busy > 0.0 { self.bonds as f64 / self.busy } else { 0.0 }
    }

    /// Mean time for which a call waited until its batch was sent, s.
    pub fn mean_wait(&self) -> f64 {
        if self.structures > 0 { self.waited / self.structures as f64 } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_added_up() {
        let device = |name: &str, busy, largest_batch, max_bonds| DeviceStatistics {
            adapter: "mace".to_owned(),
            device: name.to_owned(),
            batches: 2,
            structures: 8,
            busy,
            elapsed: 2.0,
            largest_batch,
            max_bonds,
            ..DeviceStatistics::default()
        };
        let devices = [device("cuda:0", 1.0, 4, None), device("cuda:1", 2.0, 6, Some(900))];
        let total = DeviceStatistics::total(&devices).unwrap();
        assert_eq!((total.device.as_str(), total.batches, total.structures), ("cuda:0, cuda:1", 4, 16));
        assert_eq!((total.busy_share(), total.largest_batch, total.max_bonds), (0.75, 6, Some(900)));
        assert_eq!(DeviceStatistics::total(&devices[..1]), Some(devices[0].clone()));
        assert_eq!(DeviceStatistics::total(&[]), None);
    }
}
