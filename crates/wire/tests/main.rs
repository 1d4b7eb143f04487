//! Tests of messages, shared memory and both transports.

mod common;

mod candidate_block;
mod ids;
mod ipc;
mod mixture;
mod net;
