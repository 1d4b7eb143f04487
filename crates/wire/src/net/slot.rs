//! The conversation about one turn that an agent has in hand.

use std::borrow::Cow;
use std::sync::Arc;

use tokio::time::Instant;

use super::message::{Reply, Request};
use super::uplink::{Joined, Parted, pause, read};
use crate::block::CandidateBlock;
use crate::control::{EncodedReport, checked_assignment, seal};
use crate::exchange::message::{Answer, Caller, Decision, Letter, Words};
use crate::ids::WalkId;
use crate::messages::{Outcome, Progress, Report};
use crate::transport::Work;

/// A place for one turn at a time.
#[derive(Debug)]
pub struct Slot {
    caller: Caller,
    sequence: u64,
}

/// What came of the last turn of a slot.
#[derive(Clone, Debug)]
pub enum Told {
    /// There was none.
    Nothing,
    /// This.
    Report(Report),
    /// The walker that worked on it is no more.
    Lost {
        /// By its own fault: the turn may do the same to the next one.
        fault: bool,
    },
}

impl Slot {
    pub(super) fn new(session: u64, number: u32) -> Self {
        Self { caller: Caller { session, walker: number, incarnation: 1 }, sequence: 0 }
    }

    /// Delivers what came of the last turn and waits for the next, through every break of the line; `None` when there is no
    /// more work. What was told is safe once this has returned.
    ///
    /// # Errors
    /// This agent has no place any more.
    pub async fn exchange(&mut self, joined: &Joined, told: &Told) -> Result<Option<Work>, Parted> {
        self.sequence += 1;
        let (offer, candidate) = self.offer(told);
        let question = seal(&Request::Letter(self.letter(Words::Ask { sequence: self.sequence })));
        let mut offered = false;
        loop {
            let asked = Instant::now();
            let answer = if offered {
                joined.uplink().ask(&question, None).await
            } else {
                joined.uplink().ask(&offer, candidate).await
            };
            // Whether it came or not is known by asking.
            offered = true;
            let Some(answer) = answer else {
                pause(asked).await;
                continue;
            };
            let Reply::Answer(Answer { sequence, decision }) = read(&answer)? else {
                return Err(Parted::Unreadable("it does not answer an offer".to_owned()));
            };
            if sequence != self.sequence {
                return Err(Parted::Unreadable(format!(
                    "it answers offer {sequence}, not {}",
                    self.sequence
                )));
            }
            match decision {
                Decision::Turn { mixture_version, assignment } => {
                    let assignment = checked_assignment(assignment.into_owned())?;
                    let mixture = joined.mixture(mixture_version).await?;
                    return Ok(Some(Work { assignment, mixture }));
                }
                Decision::Home => return Ok(None),
                Decision::Wait => pause(asked).await,
                Decision::Unknown => offered = false,
            }
        }
    }

    /// Tells those who watch where a walk stands. May be lost.
    pub fn progress(
        &self,
        joined: Arc<Joined>,
        walk: WalkId,
        progress: Progress,
    ) -> impl Future<Output = ()> + Send + use<> {
        let letter = self.letter(Words::Progress(walk, Cow::Owned(progress)));
        let request = seal(&Request::Letter(letter));
        async move { drop(joined.uplink().ask(&request, None).await) }
    }

    fn letter<'a>(&self, words: Words<'a>) -> Letter<'a> {
        Letter { caller: self.caller, words }
    }

    fn offer<'a>(&self, told: &'a Told) -> (Vec<u8>, Option<&'a [u8]>) {
        let (caller, sequence) = (self.caller, self.sequence);
        match told {
            Told::Nothing => {
                let words = Words::Offer { sequence, report: None };
                (seal(&Request::Letter(self.letter(words))), None)
            }
            Told::Report(report) => {
                let encoded = EncodedReport::new(report, |block| block.view().id());
                let words = Words::Offer { sequence, report: Some(encoded) };
                let candidate = match &report.outcome {
                    Outcome::Candidate(block) => Some(CandidateBlock::as_bytes(block)),
                    _ => None,
                };
                (seal(&Request::Letter(self.letter(words))), candidate)
            }
            Told::Lost { fault } => (seal(&Request::Lost { caller, sequence, fault: *fault }), None),
        }
    }
}
