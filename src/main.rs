//! calmwalk: expands the training set of an interatomic potential.

fn main() {}
