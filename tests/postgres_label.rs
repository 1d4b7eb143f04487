//! `calmwalk label` with a campaign on a PostgreSQL server.
//!
//! `CALMWALK_POSTGRES=$(.ci/postgres start) cargo test --test postgres_label`

#[path = "label.rs"]
mod label;
