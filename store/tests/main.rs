//! Tests of the store. With `CALMWALK_POSTGRES=$(.ci/postgres start)` their campaigns are on that server.

mod common;

mod assignments;
mod attempts;
mod backup;
mod budget;
mod campaign;
mod candidate_history;
mod check;
mod crash;
mod damage;
mod exclude;
mod feature_sample;
mod file;
mod history;
mod label_values;
mod listing;
mod lower_states;
mod migration;
mod outcomes;
mod processes;
mod queue;
mod queue_model;
mod relabel;
mod trajectory;
mod version_records;
mod versions;
mod walk_trace;
mod without_label;
