//! Tests of neighbour lists and of what files are read and written.

mod files;
mod neighbours;
