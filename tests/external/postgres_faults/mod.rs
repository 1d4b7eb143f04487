//! A campaign whose database is on a PostgreSQL server, on three hosts as far as one can show them: the server is restarted,
//! or away for a minute, and processes are killed. One test after the other, since they share the server.
//!
//! `CALMWALK_POSTGRES=$(.ci/postgres start) cargo test --test external postgres_faults:: -- --test-threads 1`, and with
//! `CALMWALK_KILLS=200` for the long version of the kills. Tests restart, stop and start the server with
//! `$CALMWALK_POSTGRES_CONTROL restart|crash|halt|resume`, by default `.ci/postgres`.

mod answers;
mod clocks;
mod kills;
mod restarts;
mod server;
