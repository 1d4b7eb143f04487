//! The tests of the store on a PostgreSQL server, and what is peculiar to it.
//!
//! `CALMWALK_POSTGRES=$(.ci/postgres start) cargo test -p store --test postgres`
#![allow(
    clippy::duplicate_mod,
    reason = "files that are tests by themselves, on SQLite, each bring what is common"
)]

#[path = "../backup.rs"]
mod backup;
#[path = "../campaign.rs"]
mod campaign;
#[path = "../check.rs"]
mod check;
#[path = "../common/mod.rs"]
mod common;
mod connections;
mod earlier;
#[path = "../exclude.rs"]
mod exclude;
#[path = "../history.rs"]
mod history;
mod leading;
mod leases;
#[path = "../outcomes.rs"]
mod outcomes;
#[path = "../processes.rs"]
mod processes;
mod protection;
#[path = "../queue.rs"]
mod queue;
#[path = "../queue_model.rs"]
mod queue_model;
#[path = "../relabel.rs"]
mod relabel;
mod secrets;
