//! The selector, which decides, and the reactor, which feeds it.
//!
//! The [`selector`] is a pure, synchronous core: reports in, commits out, no clock, no socket, no randomness.
//! The [`reactor`] is the thin shell round it: it takes reports from a channel, has each commit written to the
//! store, and only then answers.
//!
//! The processes of a campaign are kept alive in the same way: the [`supervisor`] decides, the [`launcher`] starts and
//! watches. Where a batch system starts processes, [`slurm`] tells it which.

pub mod grader;
pub mod launcher;
pub mod reactor;
pub mod selector;
pub mod slurm;
pub mod supervisor;
