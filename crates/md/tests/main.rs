//! Tests of the dynamics.

mod common;

mod checkpoint;
mod conservation;
mod ensembles;
mod relaxation;
