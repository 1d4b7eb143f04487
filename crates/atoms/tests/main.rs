//! Tests of neighbour lists and file formats.

mod files;
mod neighbours;
mod prototypes;
