//! What `monitor` reads, in words: texts that several views share.

pub mod budget;
pub mod calibration;
pub mod candidates;
pub mod comparison;
pub mod cost;
pub mod date;
pub mod device;
pub mod disk;
pub mod end_reason;
pub mod energies;
#[cfg(test)]
mod glossary;
pub mod history;
pub mod json;
pub mod label_progress;
pub mod labels;
pub mod parity;
pub mod reference_check;
pub mod unlabelled;
pub mod upfit;
pub mod versions;
pub mod walk_ends;
pub mod walk_trace;
