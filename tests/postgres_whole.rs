//! Tests of the whole program once more, with campaigns on a PostgreSQL server.
//!
//! `CALMWALK_POSTGRES=$(.ci/postgres start) cargo test --test postgres_whole`; needs tmux.
#![allow(
    clippy::duplicate_mod,
    reason = "files that are tests by themselves, on SQLite, each bring what is common"
)]

#[path = "backup.rs"]
mod backup;
#[path = "label.rs"]
mod label;
#[path = "relabel.rs"]
mod relabel;
#[path = "watch.rs"]
mod watch;
