//! Crystals of elements and their defects, from geometry alone.

mod crystal;
mod grain_boundary;
mod ground_state;
mod slab;
mod vacancy;

pub use crystal::Prototype;
pub use grain_boundary::{GrainBoundary, grain_boundary};
pub use ground_state::GroundState;
pub use slab::{Facet, Slab, slab};
pub use vacancy::{Vacancy, vacancy};
