//! Tests of the dynamics.

mod common;

mod barostat;
mod checkpoint;
mod conservation;
mod drift;
mod ensembles;
mod pressure;
mod relaxation;
