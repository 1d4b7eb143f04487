//! Trains new versions of the potential while a campaign runs.

pub mod schedule;
pub mod settings;
