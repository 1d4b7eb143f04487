//! Workers of a campaign: walkers run biased dynamics, labellers make labels, and agents run walkers on other
//! hosts.

pub mod agent;
pub mod bias;
pub mod cell_bias;
pub mod guard;
pub mod labeller;
pub mod settings;
pub mod walk;
pub mod walker;
