//! The optimisers of a training.

use potentials::grace::WeightGroup;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::adam::AdamState;
use crate::soap::SoapState;

/// How gradients become steps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Optimiser {
    /// Adam with AMSGrad.
    Adam,
    /// Adam in the eigenbases of Shampoo's preconditioners.
    #[default]
    Soap,
}

/// The state of an optimiser.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum OptimiserState {
    /// Of [`Optimiser::Adam`].
    Adam(AdamState),
    /// Of [`Optimiser::Soap`].
    Soap(SoapState),
}

impl Optimiser {
    /// All.
    pub const ALL: [Self; 2] = [Self::Adam, Self::Soap];

    /// Its name on the command line and in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Self::Adam => "adam",
            Self::Soap => "soap",
        }
    }

    /// Number of epochs where none is given: what SOAP does in 40 takes Adam five times as many (docs/benchmarks.md).
    pub fn default_epochs(self) -> u64 {
        match self {
            Self::Adam => 100,
            Self::Soap => 40,
        }
    }

    /// Learning rate of the first update where none is given. A step of SOAP has the same size in all directions of an array of
    /// weights, so its rate is larger.
    pub fn default_learning_rate(self) -> f64 {
        match self {
            Self::Adam => 1e-3,
            Self::Soap => 0.05,
        }
    }

    /// Number of updates over which the learning rate rises linearly. The first steps of SOAP are as large as the rate in all
    /// directions, while its eigenbases are those of few gradients: without the rise, a training of some tens of updates spoils
    /// the weights (docs/benchmarks.md).
    pub fn warm_up(self) -> u64 {
        match self {
            Self::Adam => 0,
            Self::Soap => 100,
        }
    }

    /// Its state before the first step of the weights of these groups.
    pub fn start(self, groups: &[WeightGroup]) -> OptimiserState {
        match self {
            Self::Adam => {
                OptimiserState::Adam(AdamState::new(groups.last().map_or(0, |group| group.range.end)))
            }
            Self::Soap => OptimiserState::Soap(SoapState::new(groups)),
        }
    }
}

impl OptimiserState {
    /// Number of steps made.
    pub fn steps(&self) -> u64 {
        match self {
            Self::Adam(state) => state.steps(),
            Self::Soap(state) => state.steps(),
        }
    }

    /// Changes the weights that are not frozen.
    ///
    /// # Panics
    /// If a list has another length than that of the weights of the groups.
    pub fn step(&mut self, weights: &mut [f64], gradient: &[f64], rate: f64, frozen: &[bool]) {
        match self {
            Self::Adam(state) => state.step(weights, gradient, rate, frozen),
            Self::Soap(state) => state.step(weights, gradient, rate, frozen),
        }
    }
}
