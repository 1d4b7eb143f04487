//! CALM: a calibrated extrapolation grade from a mixture of Gaussians over the feature vectors of a potential.
//!
//! This crate knows numbers, not atoms: element indices, feature vectors **z** of dimension D, and pairs.
//! A [`Mixture`] is loaded from an [`Artifact`]; [`Grades`] evaluates σ, γ and ∂γ/∂z; [`neighbourhood`]
//! averages γ over pairs; [`rules`] say when a structure is collected and when an update has done enough;
//! [`search::update`] finds the update; [`watch`] tells whether the mixture still knows its training data.
//!
//! Matrices are dense, row-major `f64`; batches of features are `[atoms × D]`, row-major.
//! All sums run in a fixed order on one thread, so results are the same bits from run to run on one kind of
//! processor (the grade: on every processor).

pub mod artifact;
mod bytes;
pub mod component;
pub mod grade;
mod ladder;
mod linear;
pub mod mixture;
pub mod movement;
pub mod neighbourhood;
mod numbers;
mod parts;
pub mod rules;
pub mod search;
pub mod soundness;
pub mod update;
pub mod watch;

pub use artifact::{Artifact, ArtifactError, Projection, ProjectionMismatch};
pub use bytes::ComponentBytesError;
pub use component::{Component, ComponentError, ComponentView, Statistics};
pub use grade::{GradeError, Grades};
pub use ladder::TrialLadder;
pub use linear::{LinearError, pseudo_inverse, regularised_inverse};
pub use mixture::{ChangedComponent, Mixture, MixtureError};
pub use neighbourhood::{Pair, neighbourhood_average};
pub use numbers::Lender;
pub use parts::GradesInParts;
pub use rules::{CollectionRule, Combination, UpdateRule, UpdateSettings};
pub use search::{Trial, UpdateEnd, UpdateOutcome, update};
pub use soundness::{ComponentFault, UnsoundComponent};
pub use update::{Batch, CovarianceUpdate, UpdateError};
