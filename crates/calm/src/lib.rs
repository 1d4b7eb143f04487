//! CALM: a calibrated extrapolation grade from a mixture of Gaussians over the feature vectors of a potential.
//!
//! This crate knows numbers, not atoms: element indices, feature vectors **z** of dimension D, and pairs.
//! A [`Mixture`] is loaded from an [`Artifact`]; [`Grades`] evaluates σ, γ and ∂γ/∂z; [`neighbourhood`]
//! averages γ over pairs; [`rules`] say when a structure is collected and when an update has done enough;
//! [`search::update`] finds the update; [`forgetting`] tells whether the mixture still knows its training data.
//!
//! Matrices are dense, row-major `f64`; batches of features are `[atoms × D]`, row-major.
//! All sums run in a fixed order on one thread, so results are the same bits from run to run on one kind of
//! processor (the grade: on every processor).

mod alpha_scan;
pub mod artifact;
mod batched_grades;
mod bytes;
pub mod component;
pub mod drift;
pub mod forgetting;
pub mod grade;
mod linear;
pub mod mixture;
pub mod neighbourhood;
pub mod rules;
pub mod search;
pub mod soundness;
mod storage;
pub mod update;

pub use alpha_scan::AlphaScan;
pub use artifact::{Artifact, ArtifactError, Projection, ProjectionMismatch};
pub use batched_grades::BatchedGrades;
pub use bytes::ComponentBytesError;
pub use component::{Component, ComponentError, ComponentView, Statistics};
pub use grade::{GradeError, Grades};
pub use linear::{LinearError, pseudo_inverse, regularised_inverse};
pub use mixture::{ChangedComponent, Mixture, MixtureError};
pub use neighbourhood::{Pair, neighbourhood_average};
pub use rules::{CollectionRule, CovarianceUpdateKind, UpdateRule, UpdateSettings};
pub use search::{Trial, UpdateEnd, UpdateOutcome, update};
pub use soundness::{ComponentFault, UnsoundComponent};
pub use storage::SharedNumbers;
pub use update::{Batch, CovarianceUpdate, UpdateError};
