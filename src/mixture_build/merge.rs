//! Combines what the parts of a build have found, pass by pass.

use std::collections::BTreeMap;
use std::path::Path;

use calm::Projection;
use calm::build::{BuildSettings, BuiltMixture};

use super::clustering::Clustered;
use super::identity::Identity;
use super::mixture;
use super::part::BuildPart;
use super::state::{BuildState, PartEnd, Partition, RunningSums};
use super::sums::{components_from_sums, histograms_from_sums};
use crate::exit_status::CommandError;

/// The state of a build in parts.
pub struct PartsMerge {
    state: BuildState,
    identity: Identity,
}

/// What a merge completed.
pub enum Merged {
    /// Pass 1 or 2.
    Pass(u8),
    /// Pass 3, and with it the build.
    Mixture(Box<BuiltMixture>),
}

impl PartsMerge {
    /// Opens the state of the build of `output`, whose model's file has the BLAKE3 hash `model_hash`.
    ///
    /// # Errors
    /// There is no such state; it belongs to another model; a process uses it.
    pub fn open(output: &Path, model_hash: &str) -> Result<Self, CommandError> {
        let (state, identity) = BuildState::open_existing(output)?;
        identity.check_model(model_hash).map_err(|difference| state.other_build(&difference))?;
        Ok(Self { state, identity })
    }

    /// The settings of the build.
    pub fn settings(&self) -> &BuildSettings {
        &self.identity.settings
    }

    /// Merges the first pass that is not merged yet.
    ///
    /// # Errors
    /// One of its parts is not done; the parts had another projection.
    pub fn run(
        &mut self,
        symbols: Vec<String>,
        projection: Projection,
        projection_seed: Option<i64>,
    ) -> Result<Merged, CommandError> {
        let same = self.identity.check_projection(&projection);
        same.map_err(|difference| self.state.other_build(&difference))?;
        let Some(partition) = self.state.partition()? else {
            let partition = self.pass_1()?.combine(&self.identity.settings, symbols.len())?;
            self.state.save_partition(&partition)?;
            return Ok(Merged::Pass(1));
        };
        let of_pass_2 = self.state.merged_sums(2)?;
        let is_complete = of_pass_2.finished.len() == partition.hashes.len();
        // A process that makes the whole build may have left the sums of some shards.
        if !is_complete {
            let sums = self.sums(2, &partition)?;
            self.state.save_sums(2, &sums)?;
        }
        if !is_complete || !self.state.has_ended_pass_2() {
            self.state.end_pass_2()?;
            return Ok(Merged::Pass(2));
        }
        let of_pass_3 = self.sums(3, &partition)?;
        let settings = self.identity.settings.clone();
        let components = components_from_sums(settings.dimension, &partition, of_pass_2.elements)?;
        let histograms = histograms_from_sums(of_pass_3.elements)?;
        let built = mixture(symbols, projection, projection_seed, settings, components, histograms)?;
        Ok(Merged::Mixture(Box::new(built)))
    }

    /// Removes the state, which a written artifact no longer needs.
    pub fn finish(self) -> Result<(), CommandError> {
        self.state.remove()
    }

    /// What all parts found in pass 1.
    fn pass_1(&self) -> Result<Clustered, CommandError> {
        let ends = self.state.part_ends()?;
        let done = |part: BuildPart| ends.contains_key(&part);
        let parts = complete(1, ends.keys().copied(), done)?;
        let (mut structures, mut hashes) = (None, BTreeMap::new());
        for part in parts {
            let PartEnd { structures: found, hashes: own } = &ends[&part];
            if structures.is_some_and(|before| before != *found) {
                return Err(CommandError::Failed(format!(
                    "part {part} of pass 1 found {found} structures in the data files, part 1 found {}: the files have changed; \
                     remove {} and start over",
                    structures.unwrap_or_default(),
                    self.state.directory().display()
                )));
            }
            structures = Some(*found);
            hashes.extend(own.iter().map(|(index, hash)| (*index, *hash)));
        }
        let known = self.state.known_shards()?;
        Ok(Clustered { structures: structures.unwrap_or_default(), hashes, known })
    }

    /// The sums of all parts in pass 2 or 3.
    fn sums(&self, pass: usize, partition: &Partition) -> Result<RunningSums, CommandError> {
        let shards = partition.hashes.len() as u64;
        let mut found = self.state.part_sums(pass)?;
        let done = |part: BuildPart| {
            part.count(shards) == found.get(&part).map_or(0, |sums| sums.finished.len() as u64)
        };
        let parts = complete(pass, found.keys().copied(), done)?;
        let mut all =
            RunningSums { elements: vec![None; partition.elements.len()], ..RunningSums::default() };
        for sums in parts.into_iter().filter_map(|part| found.remove(&part)) {
            all.finished.extend(sums.finished);
            for (total, own) in all.elements.iter_mut().zip(sums.elements) {
                match (total.as_mut(), own) {
                    (Some(total), Some(own)) => total.merge(&own).map_err(CommandError::failed)?,
                    (None, Some(own)) => *total = Some(own),
                    (_, None) => (),
                }
            }
        }
        Ok(all)
    }
}

/// The parts of a division of which all are done, of those that have begun.
fn complete(
    pass: usize,
    begun: impl Iterator<Item = BuildPart>,
    done: impl Fn(BuildPart) -> bool,
) -> Result<Vec<BuildPart>, CommandError> {
    let mut divisions: Vec<u64> = begun.map(BuildPart::total).collect();
    divisions.sort_unstable();
    divisions.dedup();
    if let Some(of) = divisions.iter().find(|of| BuildPart::all(**of).all(&done)) {
        return Ok(BuildPart::all(*of).collect());
    }
    let Some(of) = divisions.last() else {
        return Err(CommandError::Failed(format!(
            "no part of pass {pass} is done: run calmwalk calm build … --pass {pass} --part i/n for every i"
        )));
    };
    let missing: Vec<String> =
        BuildPart::all(*of).filter(|part| !done(*part)).take(10).map(|part| part.to_string()).collect();
    Err(CommandError::Failed(format!(
        "pass {pass} is not done: missing are the parts {}",
        missing.join(", ")
    )))
}
