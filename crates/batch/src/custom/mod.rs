//! A batch system that a configuration describes by its commands.

mod answer;
mod client;
mod error;
mod request;
mod settings;
mod template;
#[cfg(test)]
mod tests;

pub use answer::{CommandOutput, PolledState};
pub use client::CustomClient;
pub use error::CustomError;
pub use request::JobRequest;
pub use settings::{CustomScheduler, LogTexts, StateWords};
