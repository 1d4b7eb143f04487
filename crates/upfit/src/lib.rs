//! Fine-tunes the weights of a GRACE model on labelled structures: losses, optimisers, epochs over threads, validation and
//! checkpoints. The gradient with respect to the weights is `potentials::grace::TrainableGrace`'s.
//!
//! Results have the same bits for any number of threads and for any interruptions: every frame of a batch has its own
//! sums, which are added in the order of the frames, and random numbers are a function of random seed and epoch.

mod adam;
mod batch_gradient;
mod checkpoint;
mod collinearity;
mod data;
mod differences;
mod energy_deviations;
mod energy_zero;
mod error;
mod evaluation;
mod frame_fault;
mod frozen;
mod identity;
mod learning_rate;
mod loss;
mod optimiser;
mod prepared;
mod progress;
mod settings;
mod soap;
mod split;
mod stop_request;
#[cfg(test)]
mod test_frames;
mod trainer;

pub use data::{LabelledFrame, TrainingData, data_hash};
pub use energy_deviations::{EnergyDeviations, FarStructure};
pub use energy_zero::{ElementShift, EnergyZero, EnergyZeroFault};
pub use error::UpfitError;
pub use evaluation::{errors_of, zero_of_labels};
pub use frame_fault::{FrameFault, MAX_ENERGY_DIFFERENCE, MAX_FORCE};
pub use learning_rate::CosineDecay;
pub use loss::{LossSettings, LossStage, LossWeights};
pub use optimiser::Optimiser;
pub use progress::{EpochRecord, ErrorsBySet, SetErrors, TrainingEvent, UpdateProgress};
pub use settings::UpfitSettings;
pub use split::split;
pub use stop_request::StopRequest;
pub use trainer::{UpfitOutcome, run};
