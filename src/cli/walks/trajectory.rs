//! `calmwalk walks trajectory`

use std::path::PathBuf;

use atoms::{Cell, Structure};
use store::{Location, Store};
use wire::{WalkFrame, WalkId};

use super::walk_number;
use crate::cli::CommandError;
use crate::output::{count, print};
use crate::rerun::{find_walk, made_parts, refuse_files_of_campaign, seed_structure};
use crate::trajectory::{Trajectory, TrajectoryStep, check_name};

#[derive(Debug, clap::Args)]
pub struct TrajectoryArgs {
    /// Number of the walk, as in calmwalk status
    #[arg(value_parser = walk_number)]
    walk: u32,
    /// Trajectory file: extended XYZ, or a LAMMPS dump if its name ends in .dump or .lammpstrj; with .gz or .zst compressed
    #[arg(long, value_name = "FILE", value_parser = check_name)]
    output: PathBuf,
}

impl TrajectoryArgs {
    pub async fn run(self, location: &Location) -> Result<(), CommandError> {
        let store = Store::open_read_only(location).await?;
        let written = self.write(&store).await;
        store.close().await;
        let frames = written?;
        print(|out| writeln!(out, "{} in {}", count(frames, "frame"), self.output.display()))
    }

    /// Writes the frames part by part. Returns their number.
    async fn write(&self, store: &Store) -> Result<u64, CommandError> {
        let walk = WalkId(self.walk);
        let record = find_walk(store, walk).await?;
        refuse_files_of_campaign(store, &self.output).await?;
        let mut structure = seed_structure(store, &record).await?;
        // Created with the first frame, so that a walk without a trajectory leaves no file.
        let mut file = None;
        for part in made_parts(store.assignments(walk).await?) {
            for frame in store.trajectory_part(walk, part.part).await? {
                let file = match &mut file {
                    Some(file) => file,
                    none => none.insert(Trajectory::create(&self.output)?),
                };
                file.push(&step(&frame, &mut structure)?)?;
            }
        }
        let file: Trajectory = file.ok_or_else(|| CommandError::Input(without_frames(self.walk)))?;
        let frames = file.frames;
        file.finish()?;
        Ok(frames)
    }
}

fn step<'a>(frame: &WalkFrame, structure: &'a mut Structure) -> Result<TrajectoryStep<'a>, CommandError> {
    let (positions, atoms) = (frame.angstroms(), structure.len());
    if positions.len() != atoms {
        let found = positions.len();
        return Err(CommandError::Failed(format!(
            "a frame of the trajectory has {found} atoms, and its seed structure {atoms}: the database is damaged; restore the \
             campaign from a backup"
        )));
    }
    (structure.positions, structure.cell) = (positions, Cell(frame.cell));
    Ok(TrajectoryStep {
        structure,
        motion: None,
        segment: Some(frame.segment),
        step: frame.step,
        time: frame.time,
        temperature: frame.temperature,
        gamma: None,
    })
}

fn without_frames(walk: u32) -> String {
    format!(
        "walk {walk} has no trajectory in the store: set walk.trajectory_interval for walks that begin from now on, or make its steps again: \
         calmwalk rerun DIR {walk} --trajectory FILE"
    )
}
