//! The read side: what all views show of a campaign, read from its store and computed from it.
//!
//! [`Snapshot`] is the state of a campaign; [`candidate_details`] the history of one candidate; [`candidate_errors`] its errors for a table; [`label_statistics`]
//! the potential's errors against labels, and biased walks against their controls; [`label_cost`] what labels cost;
//! [`mixture_status`] how far the mixture has moved; [`feature_map`] where structures lie in feature space; [`versions`] the versions of its potential, and [`improvement`] what
//! one gained; [`refit_progress`] whether another one follows, [`refit_schedule`] when, and [`refit_record`] whether that is recorded; [`end_reason`] why the campaign ended; [`walk_trace`] how
//! a walk went. Nothing here writes to the store, and nothing renders: values leave
//! as numbers, or as the JSON that the documents describe.

pub mod calibration;
pub mod candidate_details;
pub mod candidate_errors;
pub mod completion_model;
pub mod disk;
pub mod end_reason;
pub mod energy_errors;
pub mod energy_offsets;
pub mod expected_end;
pub mod feature_map;
pub mod history;
pub mod improvement;
pub mod label_cost;
pub mod label_progress;
pub mod label_queue;
pub mod label_statistics;
pub mod label_value;
pub mod mixture_status;
pub mod mixture_values;
pub mod provenance;
pub mod reference_check;
pub mod refit_progress;
pub mod refit_record;
pub mod refit_schedule;
pub mod snapshot;
#[cfg(test)]
mod tests;
pub mod version_finds;
pub mod versions;
pub mod walk_ends;
pub mod walk_trace;

pub use snapshot::{DEVICES, Snapshot};
