//! A campaign on a PostgreSQL server.

mod jobs;
pub mod leadership;
pub mod open;
pub mod server;
mod size;
