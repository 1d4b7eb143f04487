//! Colliding environments (paper, SI1): different ones with the same features, explicit and found by minimisation.

mod environments;
mod feature_match;
mod lbfgs;
mod null_space;
pub mod octagon;
mod random_rows;
pub mod ranks;
pub mod search;
#[cfg(test)]
mod tests;
