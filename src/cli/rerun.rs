//! `calmwalk rerun`

use std::cell::{Cell, RefCell};
use std::num::NonZeroU64;
use std::path::{Path, PathBuf};
use std::time::Instant;

use store::Store;
use wire::WalkId;
use workers::walk::StepView;

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::{Bar, count, print};
use crate::replay::RelocatedFilesArgs;
use crate::rerun::{RerunSummary, rerun};
use crate::signals;
use crate::trajectory::{StepMotion, Trajectory, TrajectoryStep, check_name};

const BAR: &str = "{spinner} {msg}";

/// Run a walk of a campaign again from its record, to write its trajectory or to verify it
///
/// Makes every step of the walk again, with the mixtures that its walkers had, and changes nothing in the campaign. Each candidate must
/// come out with the recorded bits: structure, energy, forces and grades. Otherwise the exit code is 1. Needs the same type of processor,
/// and the files of the campaign. Walks that began under a version of calmwalk that did not record assignments cannot be run again.
///
/// Frames have energy (eV), forces (eV/Å) and stress (eV/Å³, tension positive, without the kinetic part) of the potential without bias,
/// momenta, γ of each atom under the walker's mixture, segment, step, time_fs and temperature (K). On Ctrl-C or SIGTERM, the frames so far
/// are kept.
#[derive(Debug, clap::Args)]
pub struct RerunArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Number of the walk, as in calmwalk status
    #[arg(value_name = "WALK")]
    walk: u32,
    /// Trajectory file: extended XYZ, or a LAMMPS dump if its name ends in .dump or .lammpstrj; with .gz or .zst compressed
    #[arg(long, value_name = "FILE", value_parser = check_name)]
    trajectory: Option<PathBuf>,
    /// Steps between two frames
    #[arg(long, value_name = "STEPS", default_value = "50", requires = "trajectory")]
    every: NonZeroU64,
    #[command(flatten)]
    moved: RelocatedFilesArgs,
}

impl RerunArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let started = Instant::now();
        let output = FrameOutput::new(&self);
        let summary = block_on(self.rerun(&output))?;
        let written = output.finish()?;
        let RerunSummary { candidates, end, interrupted } = summary?;
        print(|out| {
            let seconds = started.elapsed().as_secs_f64();
            let candidates = count(candidates, "candidate");
            writeln!(
                out,
                "walk {} up to step {} in {seconds:.1} s: {candidates}, all as recorded",
                self.walk, end.step
            )?;
            match (written, &self.trajectory) {
                (Some(frames), Some(path)) => {
                    writeln!(out, "{} in {}", count(frames, "frame"), path.display())
                }
                _ => Ok(()),
            }
        })?;
        Ok(if interrupted { ExitStatus::Interrupted } else { ExitStatus::Done })
    }

    async fn rerun(&self, output: &FrameOutput) -> Result<RerunSummary, CommandError> {
        let stop = signals::stop_token()?;
        let store = Store::open_read_only(&self.location.get()?).await?;
        let stopping = || stop.is_cancelled() || output.has_failed.get();
        let found =
            rerun(&store, WalkId(self.walk), &self.moved, self.trajectory.as_deref(), &stopping, |step| {
                output.observe(step)
            })
            .await;
        store.close().await;
        found
    }
}

/// Where frames go.
struct FrameOutput {
    path: Option<PathBuf>,
    /// Created with the first frame, so that a walk that cannot be run again leaves no file.
    trajectory: RefCell<Option<Trajectory>>,
    every: u64,
    bar: Bar,
    has_failed: Cell<bool>,
    failure: RefCell<Option<CommandError>>,
}

impl FrameOutput {
    fn new(arguments: &RerunArgs) -> Self {
        Self {
            path: arguments.trajectory.clone(),
            trajectory: RefCell::new(None),
            every: arguments.every.get(),
            bar: Bar::new(None, BAR),
            has_failed: Cell::new(false),
            failure: RefCell::new(None),
        }
    }

    fn observe(&self, view: &mut StepView<'_, '_>) {
        let step = view.position().step;
        self.bar.set(step, || format!("step {step}"));
        let Some(path) = self.path.as_deref().filter(|_| step.is_multiple_of(self.every)) else { return };
        if let Err(failure) = self.push(path, view) {
            self.has_failed.set(true);
            *self.failure.borrow_mut() = Some(failure);
        }
    }

    fn push(&self, path: &Path, view: &mut StepView<'_, '_>) -> Result<(), CommandError> {
        let mut trajectory = self.trajectory.borrow_mut();
        let trajectory = match &mut *trajectory {
            Some(trajectory) => trajectory,
            empty => empty.insert(Trajectory::create(path)?),
        };
        let position = view.position();
        let gamma = view.gamma();
        view.separate().map_err(CommandError::failed)?;
        trajectory.push(&TrajectoryStep {
            structure: view.structure(),
            motion: Some(StepMotion {
                velocities: view.velocities(),
                masses: view.masses(),
                evaluation: view.physical(),
            }),
            segment: Some(position.segment),
            step: position.step,
            time: view.time(),
            temperature: view.temperature(),
            gamma: gamma.as_deref(),
        })
    }

    /// Completes the file. Returns the number of its frames.
    fn finish(self) -> Result<Option<u64>, CommandError> {
        let Self { trajectory, failure, .. } = self;
        if let Some(failure) = failure.into_inner() {
            return Err(failure);
        }
        let Some(trajectory) = trajectory.into_inner() else { return Ok(None) };
        let frames = trajectory.frames;
        trajectory.finish()?;
        Ok(Some(frames))
    }
}
