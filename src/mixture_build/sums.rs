//! Passes 2 and 3: exact sums over the shards, covariances first and then histograms of σ.

use calm::build::{
    BuildError, BuiltComponent, CalibrationPass, ElementHistograms, ElementPartition, ElementSums, ExactSums,
    ScatterPass, components,
};

use super::MixtureBuild;
use super::passes::ElementPass;
use super::progress::PassProgress;
use super::state::{Partition, RunningSums};
use super::stream::Shard;
use super::workers::{Counters, run_pass};
use crate::exit_status::CommandError;
use crate::output;

/// The sums of each element, by element index.
type ElementTotals = Vec<Option<ExactSums>>;

impl MixtureBuild {
    /// Pass 2, and the components of each element.
    pub(super) fn components(
        &mut self,
        partition: &Partition,
    ) -> Result<Option<Vec<Option<Vec<BuiltComponent>>>>, CommandError> {
        let Some(sums) = self.sums_of_pass_2(partition)? else { return Ok(None) };
        self.state.end_pass_2()?;
        components_from_sums(self.settings.dimension, partition, sums).map(Some)
    }

    /// Pass 3: the histograms of each element.
    pub(super) fn histograms(
        &mut self,
        partition: &Partition,
        components: &[Option<Vec<BuiltComponent>>],
    ) -> Result<Option<Vec<Option<ElementHistograms>>>, CommandError> {
        let Some(sums) = self.sums_of_pass_3(partition, components)? else { return Ok(None) };
        histograms_from_sums(sums).map(Some)
    }

    /// The components of each element, if pass 2 of all parts is merged.
    pub(super) fn merged_components(
        &self,
        partition: &Partition,
    ) -> Result<Option<Vec<Option<Vec<BuiltComponent>>>>, CommandError> {
        let sums = self.state.merged_sums(2)?;
        if sums.finished.len() != partition.hashes.len() {
            return Ok(None);
        }
        components_from_sums(self.settings.dimension, partition, sums.elements).map(Some)
    }

    /// Counts and scatter of this process's shards.
    pub(super) fn sums_of_pass_2(
        &mut self,
        partition: &Partition,
    ) -> Result<Option<ElementTotals>, CommandError> {
        let dimension = self.settings.dimension;
        let begin = |element: usize| {
            let centroids = &partition.elements[element].centroids;
            (!centroids.is_empty()).then(|| ScatterPass::new(dimension, centroids)).transpose()
        };
        self.sums(2, partition, begin, |sums: &ElementSums| sums.to_row())
    }

    /// Histograms of σ of this process's shards.
    pub(super) fn sums_of_pass_3(
        &mut self,
        partition: &Partition,
        components: &[Option<Vec<BuiltComponent>>],
    ) -> Result<Option<ElementTotals>, CommandError> {
        let begin = |element: usize| components[element].as_deref().map(CalibrationPass::new).transpose();
        self.sums(3, partition, begin, |found: &ElementHistograms| found.to_row())
    }

    /// Pass 2 or 3: the sums of each element over this process's shards. `None` once it was stopped.
    fn sums<P: ElementPass>(
        &mut self,
        pass: usize,
        partition: &Partition,
        begin: impl Fn(usize) -> Result<Option<P>, BuildError> + Sync,
        to_row: impl Fn(&P::Partial) -> Vec<f64>,
    ) -> Result<Option<ElementTotals>, CommandError> {
        let Self { context, state, cache, bytes, .. } = self;
        let mut sums = state.sums(pass)?;
        if sums.finished.len() as u64 == context.shards().count(partition.hashes.len() as u64) {
            return Ok(Some(sums.elements));
        }
        let elements = partition.elements.len();
        sums.elements.resize(elements, None);
        let counters = Counters::default();
        let progress = PassProgress::new(pass, context.part, Some(partition.structures), *bytes, &counters);
        let finished = sums.finished.clone();
        let is_finished = |shard: &Shard| {
            if partition.hashes.get(shard.index as usize) != Some(&shard.hash) {
                return Err(changed_since_pass_1(shard));
            }
            Ok(finished.contains(&shard.index))
        };
        let ended = run_pass(
            (context, cache),
            is_finished,
            |_| (0..elements).map(&begin).collect(),
            &counters,
            |result| {
                add(
                    &mut sums,
                    result.index,
                    result.elements.iter().map(|found| found.as_ref().map(&to_row)),
                )?;
                if state.is_due() { state.save_sums(pass, &sums) } else { Ok(()) }
            },
            || progress.show(),
        );
        state.save_sums(pass, &sums)?;
        let Some(structures) = ended? else { return Ok(None) };
        if structures != partition.structures {
            return Err(CommandError::Input(format!(
                "the data files have {} now, pass 1 found {}; start over with --restart",
                output::count(structures, "structure"),
                partition.structures
            )));
        }
        progress.end(structures);
        Ok(Some(sums.elements))
    }
}

/// The components of each element, from the sums of pass 2 over all shards.
pub(super) fn components_from_sums(
    dimension: usize,
    partition: &Partition,
    sums: ElementTotals,
) -> Result<Vec<Option<Vec<BuiltComponent>>>, CommandError> {
    let of = |(found, sums): (&ElementPartition, Option<ExactSums>)| {
        let built = |sums: ExactSums| {
            let sums = ElementSums::from_row(dimension, &sums.totals())?;
            components(&found.centroids, &sums)
        };
        sums.map(built).transpose().map_err(CommandError::failed)
    };
    partition.elements.iter().zip(sums).map(of).collect()
}

/// The histograms of each element, from the sums of pass 3 over all shards.
pub(super) fn histograms_from_sums(
    sums: ElementTotals,
) -> Result<Vec<Option<ElementHistograms>>, CommandError> {
    let of = |sums: Option<ExactSums>| {
        sums.map(|sums| ElementHistograms::from_row(&sums.totals())).transpose().map_err(CommandError::failed)
    };
    sums.into_iter().map(of).collect()
}

fn changed_since_pass_1(shard: &Shard) -> CommandError {
    let place = shard.structures.first().map_or(String::new(), |first| format!(" (from {})", first.position));
    CommandError::Input(format!(
        "the structures of shard {}{place} have changed since pass 1; restore the files, or start over with --restart",
        shard.index
    ))
}

/// Adds a shard to the sums, or nothing.
fn add(
    sums: &mut RunningSums,
    shard: u64,
    rows: impl Iterator<Item = Option<Vec<f64>>>,
) -> Result<(), CommandError> {
    let wrong = |error: BuildError| CommandError::Failed(format!("shard {shard}: {error}"));
    let rows: Vec<Option<Vec<f64>>> = rows.collect();
    for (sum, row) in sums.elements.iter_mut().zip(&rows) {
        if let Some(row) = row {
            sum.get_or_insert_with(|| ExactSums::new(row.len())).check(row).map_err(wrong)?;
        }
    }
    for (sum, row) in sums.elements.iter_mut().zip(&rows) {
        if let (Some(sum), Some(row)) = (sum, row) {
            sum.add(row).map_err(wrong)?;
        }
    }
    sums.finished.insert(shard);
    Ok(())
}
