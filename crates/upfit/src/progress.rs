//! What a training reports.

use serde::{Deserialize, Serialize};

use crate::energy_deviations::EnergyDeviations;
use crate::energy_zero::EnergyZero;

/// Errors of a model on a set of structures: mean absolute (MAE) and root mean square (RMSE).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SetErrors {
    /// Number of structures.
    pub structures: u64,
    /// The loss of all structures as one batch.
    pub loss: f64,
    /// Energy, eV/atom.
    pub energy_mae: f64,
    /// Energy, eV/atom.
    pub energy_rmse: f64,
    /// Force components, eV/Å.
    pub force_mae: f64,
    /// Force components, eV/Å.
    pub force_rmse: f64,
    /// Stress components, eV/Å³; `None` without structures that have a stress.
    pub stress_mae: Option<f64>,
    /// Stress components, eV/Å³.
    pub stress_rmse: Option<f64>,
}

/// Errors of one model on both sets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorsBySet {
    /// Structures to train with.
    pub training: SetErrors,
    /// Structures for validation, if there are any.
    pub validation: Option<SetErrors>,
}

/// A finished epoch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpochRecord {
    /// From 1.
    pub epoch: u64,
    /// Index of the stage of the loss, from 0.
    pub stage: usize,
    /// Of its last update.
    pub learning_rate: f64,
    /// Of the training set during the epoch, each batch before its update; of validation, after the epoch.
    pub errors: ErrorsBySet,
    /// Updates per second of wall-clock time since the process began, with all evaluations.
    pub updates_per_second: f64,
}

/// Where a training is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpdateProgress {
    /// The epoch, from 1.
    pub epoch: u64,
    /// Number of epochs.
    pub epochs: u64,
    /// Updates made.
    pub updates: u64,
    /// Updates of all epochs.
    pub all_updates: u64,
    /// Of this process.
    pub updates_per_second: f64,
    /// Expected time until the last epoch ends; `None` before this process has made an update.
    pub seconds_left: Option<f64>,
    /// Of the last update.
    pub learning_rate: f64,
    /// Loss of the last batch, before its update.
    pub loss: f64,
    /// Of the epoch so far, each batch before its update.
    pub errors: SetErrors,
}

/// An event of a training.
#[derive(Clone, Copy, Debug)]
pub enum TrainingEvent<'a> {
    /// The training begins, or continues from a checkpoint.
    Begun {
        /// Number of epochs that the checkpoint has; `None` without one.
        resumed: Option<u64>,
        /// How the zero of the energies was moved.
        zero: &'a EnergyZero,
        /// How the labels' energies differ from the model's after it was moved.
        spread: &'a EnergyDeviations,
        /// Errors before the first update.
        before: &'a ErrorsBySet,
    },
    /// An update was made.
    Update(UpdateProgress),
    /// An epoch is over.
    Epoch {
        /// What it brought.
        record: &'a EpochRecord,
        /// Expected time until the last epoch ends; `None` before this process has made an update.
        seconds_left: Option<f64>,
    },
}
