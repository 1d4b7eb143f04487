//! Tests of the whole program that need no other programs.
//!
//! `cargo test --test integration dashboard::` runs the tests of one module. With `CALMWALK_POSTGRES=$(.ci/postgres start)`
//! the campaigns of `backup`, `label` and `relabel` are stored on that server.

mod common;

mod backup;
mod baselines;
mod batch_systems;
mod budgets;
mod calculations;
mod calm_export;
mod calm_sample;
mod calm_validate;
mod certificates;
mod cli_calm;
mod cli_campaign;
mod cli_md;
mod configs;
mod constant_pressure;
mod dashboard;
mod doctor;
mod energies;
mod errors;
mod exclude;
mod explain;
mod export;
mod failing_walks;
mod floods;
mod forgetting;
mod going_on;
mod guards;
mod hostile_labels;
mod hosts;
mod house;
mod init;
mod interruption;
mod label;
mod labelled;
mod log;
mod lower_states;
mod metrics;
mod mixture_build;
mod mutations;
mod notify;
mod places;
mod processes;
mod reference_check;
mod refit;
mod refit_campaigns;
mod relabel;
mod replay;
mod scheduling;
mod schema;
mod select;
mod status;
mod triage;
mod unlabelled_updates;
mod upfit;
mod versions;
mod walk_groups;
mod walk_traces;
mod wrong_artifacts;
mod wrong_campaign;
mod wrong_input;
mod wrong_structures;
mod wrong_values;
