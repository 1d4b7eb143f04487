//! Properties of a PostgreSQL server. The tests of `../main.rs` also run on one if `CALMWALK_POSTGRES` is set.
//!
//! `CALMWALK_POSTGRES=$(.ci/postgres start) cargo test -p store --test postgres`; run `restart`, which restarts the
//! server, separately.

#[path = "../common/mod.rs"]
mod common;
mod connections;
mod creation;
mod leading;
mod leases;
mod old_schema;
mod protection;
mod restart;
mod secrets;
#[path = "../version_records.rs"]
mod version_records;
