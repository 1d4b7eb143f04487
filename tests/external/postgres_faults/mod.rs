//! A campaign on three simulated hosts with its database on a PostgreSQL server: the server is restarted or down for a
//! minute, and processes are killed. The tests share the server, so they run one after the other.
//!
//! `CALMWALK_POSTGRES=$(.ci/postgres start) cargo test --test external postgres_faults:: -- --test-threads 1`, and with
//! `CALMWALK_KILLS=200` for the long version of the kills. Tests restart, stop and start the server with
//! `$CALMWALK_POSTGRES_CONTROL restart|crash|halt|resume`, by default `.ci/postgres`.

mod answers;
mod clocks;
mod kills;
mod refits;
mod restarts;
mod server;
