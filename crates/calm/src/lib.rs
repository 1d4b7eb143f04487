//! The CALM mixture: grade, gradient, update. Knows numbers, not atoms.
