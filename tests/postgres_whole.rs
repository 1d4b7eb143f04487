//! Tests of the whole program once more, with campaigns on a PostgreSQL server.
//!
//! `CALMWALK_POSTGRES=$(.ci/postgres start) cargo test --test postgres_whole`

#[path = "backup.rs"]
mod backup;
#[path = "label.rs"]
mod label;
