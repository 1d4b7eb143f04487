//! What the labels of a campaign have cost, and what those that wait will cost.

use std::collections::HashMap;

use analysis::{CostModel, Measured, Predicted, Size};
use serde::Serialize;
use store::{LabelCost, PendingJobs, Protocol, Store, StoreError};
use wire::ContentHash;

use crate::output::count;

/// Labels that are learned from: the newest.
const LEARNED_FROM: u32 = 1_000;

pub const SECONDS_PER_HOUR: f64 = 3600.0;

/// Hours on one core: on average, and between what they are with 90 %.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CoreHours {
    /// On average.
    pub expected: f64,
    /// With 90 % it is more than this …
    pub low: f64,
    /// … and less than this.
    pub high: f64,
}

/// The label queue, as far as it costs something.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Bill {
    /// Labels that wait or are being made.
    pub unfinished: u64,
    /// Labels whose cost was measured.
    pub measured: usize,
    /// What all attempts took by what those took that brought labels.
    pub overhead: f64,
    /// What the unfinished ones will take, with attempts in vain; none before a first label.
    pub remaining: Option<CoreHours>,
    /// Cores of the attempts under way.
    pub cores: u64,
    /// Hours until the queue is empty at that rate, if nothing is added to it.
    pub hours_left: Option<f64>,
}

/// What is known of the cost of labels by one protocol.
pub struct Costs {
    model: Option<CostModel>,
    /// What labels of one seed structure and formula were like, as the newest of them said.
    sizes: HashMap<(u32, String), Size>,
    /// See [`Bill::overhead`].
    overhead: f64,
}

impl Costs {
    /// Learns from the labels that were made by `protocol`.
    pub async fn of(store: &Store, protocol: ContentHash) -> Result<Self, StoreError> {
        let costs = store.label_costs(protocol, LEARNED_FROM).await?;
        let measured: Vec<_> = costs.iter().map(measured).collect();
        let mut sizes = HashMap::new();
        for cost in costs.iter().rev() {
            sizes.insert((cost.seed_structure, cost.formula.clone()), size(cost));
        }
        let work = store.label_usage().await?;
        let overhead = work.core_seconds.zip(work.label_core_seconds.filter(|brought| *brought > 0.0));
        let overhead = overhead.map_or(1.0, |(all, brought)| (all / brought).max(1.0));
        Ok(Self { model: CostModel::fit(&measured, None), sizes, overhead })
    }

    /// From a model that is there.
    pub fn by(model: Option<CostModel>) -> Self {
        Self { model, sizes: HashMap::new(), overhead: 1.0 }
    }

    /// Labels that it learned from.
    pub fn measured(&self) -> usize {
        self.model.as_ref().map_or(0, CostModel::labels)
    }

    /// What labels of these sizes take together, so many of each.
    pub fn predict(&self, sizes: impl IntoIterator<Item = (Size, u64)>) -> Option<CoreHours> {
        let predicted = self.model.as_ref()?.predict_all(sizes)?;
        Some(CoreHours::of(predicted, self.overhead))
    }

    /// A label of that seed structure and formula is like the last; of others, only the number of atoms is known.
    fn size_of(&self, waiting: &PendingJobs) -> Size {
        let known = self.sizes.get(&(waiting.seed_structure, waiting.formula.clone()));
        let other = self.sizes.values().next();
        known.copied().unwrap_or_else(|| {
            let atoms = f64::from(waiting.atoms);
            // Methods without electrons have no mesh either; with them the size is not known, and the model says so.
            let electrons = other.and_then(|other| other.electrons).map(|_| f64::NAN);
            Size { atoms, electrons, k_points: 1.0 }
        })
    }
}

/// The bill of the jobs that have no label of `protocol` yet.
pub async fn of(store: &Store, protocol: ContentHash) -> Result<Bill, StoreError> {
    let waiting = store.waiting_jobs(protocol).await?;
    let (costs, work) = (Costs::of(store, protocol).await?, store.label_usage().await?);
    let remaining = costs.predict(waiting.iter().map(|waiting| (costs.size_of(waiting), waiting.jobs)));
    let hours_left = remaining.filter(|_| work.cores > 0).map(|hours| hours.expected / work.cores as f64);
    Ok(Bill {
        unfinished: waiting.iter().map(|waiting| waiting.jobs).sum(),
        measured: costs.measured(),
        overhead: costs.overhead,
        remaining,
        cores: work.cores,
        hours_left,
    })
}

/// What labels that are made again may cost.
pub struct Again {
    /// None before a first label.
    pub hours: Option<CoreHours>,
    /// Labels whose cost was measured.
    pub measured: usize,
    /// Name of their protocol.
    pub protocol: String,
}

/// What these will cost, as labels of the protocol in force did; before it has any, as those of the last one that has.
pub async fn again(
    store: &Store,
    in_force: &Protocol,
    structures: &[PendingJobs],
) -> Result<Again, StoreError> {
    let mut protocol = in_force.clone();
    let mut costs = Costs::of(store, protocol.hash).await?;
    for earlier in store.protocols().await?.into_iter().rev() {
        if costs.measured() == 0 {
            costs = Costs::of(store, earlier.hash).await?;
            protocol = earlier;
        }
    }
    let hours = costs.predict(structures.iter().map(|waiting| (costs.size_of(waiting), waiting.jobs)));
    Ok(Again { hours, measured: costs.measured(), protocol: protocol.name })
}

impl std::fmt::Display for Again {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { hours, measured, protocol } = self;
        match hours {
            Some(hours) => {
                let measured = count(*measured, "label");
                write!(f, "about {hours}, if they take as long as {measured} by '{protocol}' did")
            }
            None => write!(f, "unknown, since that of no label was measured"),
        }
    }
}

impl CoreHours {
    /// So many times as much.
    pub fn times(self, factor: f64) -> Self {
        Self { expected: factor * self.expected, low: factor * self.low, high: factor * self.high }
    }

    /// From core-seconds, times a factor.
    pub fn of(predicted: Predicted, factor: f64) -> Self {
        let hours = |seconds: f64| factor * seconds / SECONDS_PER_HOUR;
        Self {
            expected: hours(predicted.core_seconds),
            low: hours(predicted.low),
            high: hours(predicted.high),
        }
    }
}

impl std::fmt::Display for CoreHours {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [expected, low, high] = [self.expected, self.low, self.high].map(digits);
        write!(f, "{expected} core-hours ({low} to {high} with 90 %)")
    }
}

/// Two digits that count, and whole numbers from ten on.
pub fn digits(x: f64) -> String {
    if !(x.is_finite() && x > 0.0) {
        return format!("{x}");
    }
    let decimals = (1.0 - x.log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{x:.decimals$}")
}

/// What the cost of a label depends on, as its method says.
pub fn size_of(size: &dft::Size) -> Size {
    let electrons = Some(size.electrons).filter(|electrons| *electrons > 0.0);
    Size { atoms: size.atoms as f64, electrons, k_points: size.k_points as f64 }
}

fn size(cost: &LabelCost) -> Size {
    Size {
        atoms: cost.atoms.into(),
        electrons: cost.electrons.filter(|electrons| *electrons > 0.0),
        k_points: cost.k_points.unwrap_or(1).into(),
    }
}

fn measured(cost: &LabelCost) -> Measured {
    Measured { size: size(cost), core_seconds: cost.core_seconds }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hours_have_two_digits() {
        for (x, text) in [
            (0.0, "0"),
            (0.001_234, "0.0012"),
            (0.5, "0.50"),
            (3.26, "3.3"),
            (42.7, "43"),
            (12_345.6, "12346"),
        ] {
            assert_eq!(digits(x), text);
        }
        let hours = CoreHours::of(Predicted { core_seconds: 3600.0, low: 1800.0, high: 9000.0 }, 2.0);
        assert_eq!(hours.to_string(), "2.0 core-hours (1.0 to 5.0 with 90 %)");
    }
}
