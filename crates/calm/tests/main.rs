//! Tests of the grade, its rules and the mixture.

mod common;

mod artifact;
mod baselines;
mod build;
mod forgetting;
mod grade;
mod greedy;
mod properties;
mod rules;
mod selection;
mod soundness;
mod update;
