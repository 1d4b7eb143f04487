//! The actors that do the work: the walker runs biased dynamics, the labeller gives structures their labels.

pub mod agent;
pub mod bias;
pub mod guard;
pub mod labeller;
pub mod settings;
pub mod walk;
pub mod walker;
