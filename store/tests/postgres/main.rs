//! What is peculiar to a PostgreSQL server. The tests of `../main.rs` run on one as well if `CALMWALK_POSTGRES` names it.
//!
//! `CALMWALK_POSTGRES=$(.ci/postgres start) cargo test -p store --test postgres`; `restart`, which restarts the server, by itself.

#[path = "../common/mod.rs"]
mod common;
mod connections;
mod leading;
mod leases;
mod old_schema;
mod protection;
mod restart;
mod secrets;
