//! Tests of walks and labellers.

#[path = "../../store/tests/common/mod.rs"]
mod common;
#[path = "../../tests/common/mutate.rs"]
mod mutate;

mod calculations;
mod constant_pressure;
mod deep_models;
mod labeller;
mod norm_interval;
mod trace;
mod trajectory;
mod update_work;
mod walk;
