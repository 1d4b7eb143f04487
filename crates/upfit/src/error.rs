//! Why a training cannot begin or continue.

use std::path::PathBuf;

use crate::energy_zero::EnergyZeroFault;
use crate::frame_fault::FrameFault;

/// Why a training cannot begin or continue.
#[derive(Debug, thiserror::Error)]
pub enum UpfitError {
    /// A setting out of its range.
    #[error("{name} is {found}, expected {expected}")]
    Setting {
        /// The setting.
        name: &'static str,
        /// Its value.
        found: String,
        /// The valid values.
        expected: &'static str,
    },
    /// A stage of the loss without epochs.
    #[error(
        "stage {stage} of the loss begins after a share of {begins:.3} of {epochs} epochs and has none; expected at least one epoch \
         for each stage: train for more epochs"
    )]
    StageWithoutEpochs {
        /// The stage, from 1.
        stage: usize,
        /// Share of the epochs after which it begins.
        begins: f64,
        /// Number of epochs.
        epochs: u64,
    },
    /// A labelled structure that cannot be used.
    #[error("{place}: {fault}")]
    Frame {
        /// Where the structure comes from.
        place: String,
        /// What is wrong.
        fault: FrameFault,
    },
    /// No structures to train with.
    #[error("there are no labelled structures to train with")]
    NoFrames,
    /// A single seed structure, of which no part is held out.
    #[error(
        "{structures} structures belong to one seed structure, {group}; expected at least 2 to hold out a share of {share} for \
         validation, since a seed structure is not divided: name a file for validation, or a share of 0 to train without"
    )]
    OneGroup {
        /// The share asked for.
        share: f64,
        /// Number of structures.
        structures: usize,
        /// The seed structure.
        group: String,
    },
    /// A group of weights to freeze that the model does not have.
    #[error("no weights of the model have a name that begins with '{pattern}'; it has {known}")]
    UnknownGroup {
        /// What was asked for.
        pattern: String,
        /// Names of the groups.
        known: String,
    },
    /// Every weight is frozen.
    #[error("all weights of the model are frozen: nothing is left to train")]
    AllFrozen,
    /// The zero of the energies cannot be found.
    #[error(transparent)]
    EnergyZero(#[from] EnergyZeroFault),
    /// Loss or gradient is NaN or infinite.
    #[error(
        "epoch {epoch}, {place}: {what} is not finite, structures {frames}; the last checkpoint is kept. A lower learning rate may \
         help, or other labels"
    )]
    NotFinite {
        /// The epoch, from 1.
        epoch: u64,
        /// The batch, the validation, or the last update.
        place: String,
        /// Loss or gradient.
        what: &'static str,
        /// Where the structures come from.
        frames: String,
    },
    /// A checkpoint of a training with another model, data or settings.
    #[error(
        "{}: checkpoint of another training: its {name} is {saved}, now it is {now}; remove the file to start over, or name another \
         one",
        path.display()
    )]
    OtherTraining {
        /// The checkpoint.
        path: PathBuf,
        /// What differs.
        name: String,
        /// In the checkpoint.
        saved: String,
        /// In this training.
        now: String,
    },
    /// The system cannot create threads.
    #[error("cannot start {threads} threads: {reason}")]
    Threads {
        /// Their number.
        threads: usize,
        /// The error of the operating system.
        reason: String,
    },
    /// A file that is no checkpoint, or a damaged one.
    #[error("{}: {reason}; remove the file to start over, or name another one", path.display())]
    Damaged {
        /// The checkpoint.
        path: PathBuf,
        /// What is wrong.
        reason: &'static str,
    },
    /// A checkpoint that cannot be read.
    #[error("{}: cannot be read: {source}", path.display())]
    ReadCheckpoint {
        /// The checkpoint.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// A checkpoint that cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    WriteCheckpoint {
        /// The checkpoint.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
}

impl UpfitError {
    /// Whether the input is wrong, as opposed to a failure on the way.
    pub fn is_wrong_input(&self) -> bool {
        !matches!(
            self,
            Self::NotFinite { .. }
                | Self::Threads { .. }
                | Self::Damaged { .. }
                | Self::ReadCheckpoint { .. }
                | Self::WriteCheckpoint { .. }
        )
    }
}
