//! Tests of the selector, the reactor and the supervisor.

mod common;

mod batch_plan;
mod commit_batch;
mod completion;
mod decisions;
mod forgetting;
mod nothing_new;
mod reactor;
mod replay;
mod reproducible;
mod simulation;
mod supervisor;
mod versions;
mod walks;
