//! The graph atomic cluster expansion (GRACE) and its CALM features, in double precision.
//!
//! Reads the `kokkos.npz` file that gracemaker exports for LAMMPS. The model's maths is that of
//! Bochkarev, Lysogorskiy and Drautz, Phys. Rev. X 14, 021036 (2024); the feature map is that of the CALM paper
//! (Methods, "Latent features and uncertainty models").
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
//! let cotangent = vec![1.0; grace.features().len()]; // ∂H/∂z, here of H = Σ z
//! let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
//! grace.backward(Some(&cotangent), &mut energy, &mut pull_back);
//! # Ok(())
//! # }
//! ```

mod bonds;
mod error;
mod evaluate;
mod graph;
mod harmonics;
mod matrix;
mod model;
mod one_layer;
mod projection;
mod radial;
mod radial_table;
mod readout;
mod tape;

pub use error::GraceError;
pub use evaluate::{Grace, PullBack};
pub use model::{Architecture, GraceDescription, GraceModel};
pub use projection::Projection;
pub use radial::RadialPath;
