//! Estimates the disk space of a campaign from its limits.

use monitor::disk::DiskForecast;
use wire::MAX_KEPT_POINTS;

use crate::campaign::LoadedCampaign;
use crate::config::Config;

/// Decision, candidate, job, attempt and label with their indexes, without what scales with the number of atoms,
/// bytes.
const ROW_BYTES: u64 = 4_000;
/// Half a page, which a row longer than a page wastes on average, bytes.
const HALF_PAGE_BYTES: u64 = 8_192;
/// An empty database: every table and index takes a page, bytes.
const EMPTY_DATABASE_BYTES: u64 = 500_000;
/// A walk's checkpoints, bytes per atom.
const CHECKPOINT_BYTES_PER_ATOM: u64 = 450;
/// A point of the trace of a walk, bytes.
const POINT_BYTES: u64 = 152;
/// The record of an assignment of a walk, bytes.
const ASSIGNMENT_BYTES: u64 = 100;
/// A frame of the trajectory of a walk, bytes per atom.
const FRAME_BYTES_PER_ATOM: u64 = 12;
/// More than any disk has.
const LARGEST_BYTES: u64 = u64::MAX / 8;
/// Largest size of SQLite's write-ahead log, bytes.
pub const WAL_BYTES: u64 = 70_000_000;

/// Estimates the disk space of a campaign that collects all that its configuration allows.
pub fn estimate(campaign: &LoadedCampaign) -> DiskForecast {
    let config = &campaign.config;
    let features = campaign.artifact.mixture.dimension() as u64;
    let seeds = || campaign.seed_structures.iter().map(|named| named.plan.structure.len() as u64);
    let number = seeds().len() as u64;
    let walks = || campaign.seed_structures.iter().map(|named| named.plan.walks.len());
    let collected = walks().map(|walks| config.max_structures_of(walks)).fold(0, u64::saturating_add);
    let collected =
        config.collect.max_structures.map_or(collected, |total| collected.min(total.get().into()));
    let copies = if config.campaign.control { 2 } else { 1 };
    let mean = seeds().map(|atoms| structure_bytes(atoms, features)).sum::<u64>() / number.max(1);
    let records = trace_bytes(config) + assignment_bytes(config);
    let walk = |atoms| {
        CHECKPOINT_BYTES_PER_ATOM * atoms + HALF_PAGE_BYTES + records + trajectory_bytes(config, atoms)
    };
    let walks = seeds().zip(walks()).map(|(atoms, walks)| (walks as u64).saturating_mul(walk(atoms)));
    // Sums of it do not overflow.
    let walks = walks.fold(0, u64::saturating_add).min(LARGEST_BYTES);
    let mixture: usize =
        campaign.artifact.mixture.iter().map(|(.., component)| component.to_bytes().len()).sum();
    DiskForecast {
        structures: copies * collected * mean,
        rest: EMPTY_DATABASE_BYTES + copies * walks + mixture as u64,
        declined: config.collect.declined_features_mb * 1_000_000,
        max_structures: copies * collected,
    }
}

fn steps(config: &Config) -> u64 {
    config.walk.equilibration_steps.saturating_add(config.walk.biased_steps.get())
}

/// The records of the assignments of a walk that makes all its steps. Those that end with a candidate are negligible beside it.
fn assignment_bytes(config: &Config) -> u64 {
    ASSIGNMENT_BYTES * (steps(config) / config.run.steps_per_assignment.get())
}

/// The trace of a walk that makes all its steps.
fn trace_bytes(config: &Config) -> u64 {
    match steps(config).checked_div(config.walk.trace_interval) {
        Some(points) => {
            POINT_BYTES * points.saturating_add(1).min(MAX_KEPT_POINTS as u64 + 1) + HALF_PAGE_BYTES
        }
        None => 0,
    }
}

/// The trajectory of a walk that makes all its steps.
fn trajectory_bytes(config: &Config, atoms: u64) -> u64 {
    let Some(frames) = steps(config).checked_div(config.walk.trajectory_interval) else { return 0 };
    let parts = frames.min(steps(config) / config.run.steps_per_assignment.get()).saturating_add(1);
    let frame = FRAME_BYTES_PER_ATOM * atoms + ASSIGNMENT_BYTES;
    frames.saturating_add(1).saturating_mul(frame).saturating_add(parts.saturating_mul(HALF_PAGE_BYTES))
}

/// A structure with its candidate, features, grades and label.
fn structure_bytes(atoms: u64, features: u64) -> u64 {
    let block = 288 + 72 * atoms;
    let (features, grades) = (8 * atoms * features, 2 * 16 * atoms);
    let (positions, forces) = (25 * atoms, 24 * atoms);
    block + features + grades + positions + forces + ROW_BYTES + HALF_PAGE_BYTES
}
