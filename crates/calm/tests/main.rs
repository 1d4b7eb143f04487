//! Tests of the grade, its rules and the mixture.

mod common;

mod artifact;
mod baselines;
mod build;
mod forgetting;
mod grade;
mod properties;
mod rules;
mod selection;
mod soundness;
mod update;
