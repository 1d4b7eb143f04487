//! The orchestrator of a campaign.
//!
//! The [`selector`] is a pure, synchronous core that decides: reports in, commits out, without clock, socket or
//! randomness. The [`reactor`] drives it: it receives reports from a channel, writes each commit to the store, and only
//! then answers.
//!
//! Process supervision has the same structure: the [`supervisor`] decides, the [`launcher`] starts and monitors
//! processes. If a batch system starts the processes, [`batch`] decides which jobs to submit.

pub mod batch;
pub mod grader;
pub mod launcher;
pub mod reactor;
pub mod selector;
pub mod supervisor;
