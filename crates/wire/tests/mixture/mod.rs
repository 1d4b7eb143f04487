//! The mixture in shared memory: versions, blocks, readers in this process and in others.

mod files;
mod helpers;
mod life;
mod model;
mod processes;
