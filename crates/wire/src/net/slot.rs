//! A slot of an agent: the exchange of reports and assignments for one walk at a time.

use std::borrow::Cow;
use std::sync::Arc;

use tokio::time::Instant;

use super::agent_client::{Membership, delay_retry};
use super::link_error::{LinkError, decode_reply};
use super::message::{AgentReply, AgentRequest};
use crate::block::CandidateBlock;
use crate::control::{EncodedReport, checked_assignment, encode};
use crate::ids::WalkId;
use crate::messages::{Assignment, AssignmentReport, Outcome, WalkProgress};
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

/// What the orchestrator answers about the current offer of a slot.
#[derive(Clone, Debug)]
pub(super) enum SlotAnswer {
    /// The report is committed; the next assignment, with the version of its mixture.
    Assignment(Box<Assignment>, u64),
    /// There is no more work.
    Shutdown,
    /// The decision is pending: poll again.
    Pending,
    /// The offer was not received: send it again.
    Unknown,
}

impl Membership {
    /// The slots of this agent.
    pub fn slots(&self) -> Vec<Slot> {
        self.slot_numbers().map(|number| Slot::new(self.session, number)).collect()
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
        self.begin_offer();
        let (offer, candidate) = self.offer(report);
        let poll = self.poll();
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
            match self.read(&answer)? {
                SlotAnswer::Assignment(assignment, version) => {
                    let mixture = membership.mixture(version).await?;
                    return Ok(Some(WorkItem { assignment: *assignment, mixture }));
                }
                SlotAnswer::Shutdown => return Ok(None),
                SlotAnswer::Pending => delay_retry(sent_at).await,
                SlotAnswer::Unknown => offered = false,
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

    /// A slot of an agent that has joined, before its first offer.
    pub(super) fn new(session: u64, number: u32) -> Self {
        Self { sender: SenderId { session, walker: number, incarnation: 1 }, sequence: 0 }
    }

    /// Session of the orchestrator.
    pub(super) fn session(&self) -> u64 {
        self.sender.session
    }

    /// Begins the next offer.
    pub(super) fn begin_offer(&mut self) {
        self.sequence += 1;
    }

    /// A question about the current offer.
    pub(super) fn poll(&self) -> Vec<u8> {
        let poll = self.envelope(Payload::Poll { sequence: self.sequence });
        encode(&AgentRequest::Envelope(Box::new(poll)))
    }

    /// Reads the answer to the current offer.
    pub(super) fn read(&self, answer: &[u8]) -> Result<SlotAnswer, LinkError> {
        let AgentReply::Answer(Answer { sequence, body }) = decode_reply(answer)? else {
            return Err(LinkError::InvalidReply("it is not an answer to an offer".to_owned()));
        };
        if sequence != self.sequence {
            let why = format!("it answers offer {sequence}, not {}", self.sequence);
            return Err(LinkError::InvalidReply(why));
        }
        Ok(match body {
            AnswerBody::Assignment { mixture_version, assignment } => {
                let assignment = checked_assignment(assignment.into_owned())?;
                SlotAnswer::Assignment(Box::new(assignment), mixture_version)
            }
            AnswerBody::Shutdown => SlotAnswer::Shutdown,
            AnswerBody::Pending => SlotAnswer::Pending,
            AnswerBody::Unknown => SlotAnswer::Unknown,
        })
    }

    fn envelope<'a>(&self, payload: Payload<'a>) -> Envelope<'a> {
        Envelope { sender: self.sender, payload }
    }

    /// The current offer, and its candidate.
    pub(super) fn offer<'a>(&self, slot_report: &'a SlotReport) -> (Vec<u8>, Option<&'a [u8]>) {
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
