//! Tests of the grades of a model.

pub mod labelled;
