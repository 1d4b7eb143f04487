//! A slot of an agent: the exchange of reports and assignments for one walk at a time.

use std::borrow::Cow;
use std::sync::Arc;

use tokio::time::Instant;

use super::agent_client::{LinkError, Membership, decode_reply, delay_retry};
use super::message::{AgentReply, AgentRequest};
use crate::block::CandidateBlock;
use crate::control::{EncodedReport, checked_assignment, encode};
use crate::ids::WalkId;
use crate::messages::{AssignmentReport, Outcome, WalkProgress};
use crate::protocol::message::{Answer, AnswerBody, Envelope, Payload, SenderId};
use crate::transport::WorkItem;

/// A slot for one assignment at a time.
#[derive(Debug)]
pub struct Slot {
    sender: SenderId,
    sequence: u64,
}

/// Result of a slot's last assignment.
#[derive(Clone, Debug)]
pub enum SlotReport {
    /// There was no assignment.
    Empty,
    /// The walker's report.
    Report(Box<AssignmentReport>),
    /// The walker has exited.
    Lost {
        /// Whether it crashed: the assignment may crash the next walker as well.
        crashed: bool,
    },
}

impl Membership {
    /// The slots of this agent.
    pub fn slots(&self) -> Vec<Slot> {
        let sender = |walker| SenderId { session: self.session, walker, incarnation: 1 };
        self.slot_numbers().map(|number| Slot { sender: sender(number), sequence: 0 }).collect()
    }
}

impl Slot {
    /// Delivers the last report and waits for the next assignment, across broken links. Returns `None` when there is no
    /// more work. The report is committed once this has returned `Ok`.
    ///
    /// # Errors
    /// The agent must join again, or the orchestrator's answer is invalid.
    pub async fn exchange(
        &mut self,
        membership: &Membership,
        report: &SlotReport,
    ) -> Result<Option<WorkItem>, LinkError> {
        self.sequence += 1;
        let (offer, candidate) = self.offer(report);
        let poll = encode(&AgentRequest::Envelope(Box::new(
            self.envelope(Payload::Poll { sequence: self.sequence }),
        )));
        let mut offered = false;
        loop {
            let sent_at = Instant::now();
            let answer = if offered {
                membership.client().send_once(&poll, None).await
            } else {
                membership.client().send_once(&offer, candidate).await
            };
            // Whether the offer arrived is found out by polling.
            offered = true;
            let Some(answer) = answer else {
                delay_retry(sent_at).await;
                continue;
            };
            let AgentReply::Answer(Answer { sequence, body }) = decode_reply(&answer)? else {
                return Err(LinkError::InvalidReply("it is not an answer to an offer".to_owned()));
            };
            if sequence != self.sequence {
                return Err(LinkError::InvalidReply(format!(
                    "it answers offer {sequence}, not {}",
                    self.sequence
                )));
            }
            match body {
                AnswerBody::Assignment { mixture_version, assignment } => {
                    let assignment = checked_assignment(assignment.into_owned())?;
                    let mixture = membership.mixture(mixture_version).await?;
                    return Ok(Some(WorkItem { assignment, mixture }));
                }
                AnswerBody::Shutdown => return Ok(None),
                AnswerBody::Pending => delay_retry(sent_at).await,
                AnswerBody::Unknown => offered = false,
            }
        }
    }

    /// Sends the current state of a walk, for display. May be lost.
    pub fn progress(
        &self,
        membership: Arc<Membership>,
        walk: WalkId,
        progress: WalkProgress,
    ) -> impl Future<Output = ()> + Send + use<> {
        let envelope = self.envelope(Payload::Progress(walk, Cow::Owned(progress)));
        let request = encode(&AgentRequest::Envelope(Box::new(envelope)));
        async move { drop(membership.client().send_once(&request, None).await) }
    }

    fn envelope<'a>(&self, payload: Payload<'a>) -> Envelope<'a> {
        Envelope { sender: self.sender, payload }
    }

    fn offer<'a>(&self, slot_report: &'a SlotReport) -> (Vec<u8>, Option<&'a [u8]>) {
        let (sender, sequence) = (self.sender, self.sequence);
        match slot_report {
            SlotReport::Empty => {
                let payload = Payload::Offer { sequence, report: None };
                (encode(&AgentRequest::Envelope(Box::new(self.envelope(payload)))), None)
            }
            SlotReport::Report(report) => {
                let encoded = EncodedReport::new(report, |block| block.view().id());
                let payload = Payload::Offer { sequence, report: Some(encoded) };
                let candidate = match &report.outcome {
                    Outcome::Candidate(block) => Some(CandidateBlock::as_bytes(block)),
                    _ => None,
                };
                (encode(&AgentRequest::Envelope(Box::new(self.envelope(payload)))), candidate)
            }
            SlotReport::Lost { crashed } => {
                (encode(&AgentRequest::Lost { sender, sequence, crashed: *crashed }), None)
            }
        }
    }
}
