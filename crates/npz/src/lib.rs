//! Reads arrays of NumPy `.npz` archives and checks every size against the data before using it; writes such archives.
//!
//! ```no_run
//! # fn read() -> Result<(), npz::Error> {
//! let archive = npz::NpzFile::open("kokkos.npz".as_ref())?;
//! let layers = archive.count("n_layers", 1, 64)?;
//! let weights = archive.floats("weights", &[layers, 3])?;
//! # Ok(())
//! # }
//! ```

mod archive;
mod array;
mod checked;
mod error;
mod header;
mod writer;

pub use archive::NpzFile;
pub use array::Array;
pub use error::Error;
pub use writer::{Writer, names};
