//! The graph atomic cluster expansion (GRACE) and its CALM features, in double or mixed precision
//! ([`Precision`]).
//!
//! Reads the `kokkos.npz` file that gracemaker exports for LAMMPS. The model is that of Bochkarev, Lysogorskiy
//! and Drautz, Phys. Rev. X 14, 021036 (2024); the feature map is that of the CALM paper (Methods, "Latent
//! features and uncertainty models").
//!
//! ```no_run
//! # use std::{path::Path, sync::Arc};
//! # use atoms::{Evaluation, NeighbourList, Structure};
//! # use potentials::grace::{Grace, GraceModel, PullBack};
//! # fn step(structure: &Structure) -> Result<(), Box<dyn std::error::Error>> {
//! let model = Arc::new(GraceModel::load(Path::new("kokkos.npz"))?);
//! let mut neighbours = NeighbourList::new(model.cutoff(), 0.5);
//! let mut grace = Grace::new(model);
//! neighbours.update(structure)?;
//! grace.forward(structure, &neighbours)?;
//! let cotangent = vec![1.0; grace.features().len()]; // ∂H/∂z, here for H = Σ z
//! let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
//! grace.backward(Some(&cotangent), &mut energy, &mut pull_back);
//! # Ok(())
//! # }
//! ```

mod activation;
mod basis;
mod batch_passes;
mod batches;
mod block_aliases;
mod bonds;
mod builder;
mod chunked_slices;
mod cost;
mod description;
mod element_factors;
mod equivariant_graph;
mod equivariant_norm;
mod error;
mod evaluate;
mod graph;
mod harmonics;
mod hidden_features;
mod hidden_layer;
mod instructions;
mod invariant_norm;
mod last_layer;
mod layer;
mod layer_passes;
mod linear;
mod load;
mod matrix;
mod messages;
mod model;
mod network;
mod networks;
mod one_layer;
mod potential;
mod precision;
mod product;
mod projection;
mod radial;
mod radial_network;
mod radial_table;
mod read_options;
mod readout;
mod reduction;
mod register_allocation;
mod schedule;
mod scratch;
mod shared_reader;
mod sweeps;
mod symmetry;
mod tape;
mod tape_program;
mod threads;
mod three_layers;
mod training;
mod two_layers;
mod vector;
mod weight_arrays;
mod weight_gradient;
mod weight_map;
mod weights;

pub use description::{Architecture, GraceDescription};
pub use error::{GraceError, UnfitProjection};
pub use evaluate::{GradeFunction, PullBack};
pub use hidden_features::HiddenLayerModel;
pub use instructions::Instructions;
pub(crate) use instructions::SimdPass;
pub use model::GraceModel;
pub use potential::Grace;
pub use precision::Precision;
pub use projection::{FeatureForm, GraceProjection};
pub use radial::RadialPath;
pub use shared_reader::NOTE;
pub use threads::Threads;
pub use training::{GradientWorker, LossGradient, TrainableGrace, WeightGroup, WeightSums};
