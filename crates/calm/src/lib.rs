//! CALM: a calibrated extrapolation grade from a mixture of Gaussians over the feature vectors of a potential.
//!
//! This crate works on numbers, not atoms: element indices, feature vectors **z** of dimension D, and pairs. An
//! [`Artifact`] holds a [`Mixture`]; [`Grades`] evaluates σ, γ and ∂γ/∂z; [`neighbourhood`] averages γ over
//! pairs; [`rules`] decides when a structure is collected and when an update is sufficient; [`search::update`]
//! finds the update; [`forgetting`] detects whether the mixture still covers its training data. [`build`] makes a
//! mixture from training data, [`baselines`] the scores that γ is compared with. [`weighted_sample`] draws structures that stand
//! for a data set.
//!
//! Matrices are dense, row-major `f64`; batches of features are `[atoms × D]`, row-major. All sums run in a
//! fixed order on one thread, so results are bitwise reproducible on one kind of processor (grades on every
//! processor).

mod alpha_scan;
pub mod artifact;
pub mod baselines;
mod batched_grades;
pub mod build;
mod bytes;
pub mod component;
pub mod drift;
pub mod forgetting;
pub mod grade;
mod linear;
pub mod mixture;
mod moments;
pub mod neighbourhood;
pub mod rules;
pub mod search;
pub mod selection;
pub mod soundness;
pub mod staleness;
mod storage;
pub mod update;
pub mod weighted_sample;

pub use alpha_scan::AlphaScan;
pub use artifact::{Artifact, ArtifactError, Projection, ProjectionMismatch};
pub use batched_grades::BatchedGrades;
pub use bytes::ComponentBytesError;
pub use component::{Component, ComponentError, ComponentView, Statistics};
pub use grade::{GradeError, Grades};
pub use linear::{LinearError, pseudo_inverse, regularised_inverse};
pub use mixture::{ChangedComponent, Mixture, MixtureError};
pub use moments::moments;
pub use neighbourhood::{NeighbourWeights, Pair, neighbourhood_average};
pub use rules::{CollectionRule, CovarianceUpdateKind, UpdateRule, UpdateSettings};
pub use search::{Trial, UpdateEnd, UpdateOutcome, update};
pub use soundness::{ComponentFault, UnsoundComponent};
pub use staleness::Staleness;
pub use storage::SharedNumbers;
pub use update::{Batch, CovarianceUpdate, UpdateError};
