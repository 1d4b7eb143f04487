//! The selector, which decides, and the reactor, which feeds it.
//!
//! The [`selector`] is a pure, synchronous core: reports in, commits out, no clock, no socket, no randomness.
//! The [`reactor`] is the thin shell round it: it takes reports from a channel, has each commit written to the
//! store, and only then answers.

pub mod grader;
pub mod reactor;
pub mod selector;
pub mod supervisor;
