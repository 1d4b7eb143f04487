//! Decodes a message and encodes it again, for tests and the fuzz target: this covers all validation of received
//! messages.

use serde::Serialize;
use zerocopy::IntoBytes;

use crate::block::{Candidate, CandidateBlock};
use crate::control::{decode, encode};
use crate::protocol::frame;
use crate::protocol::message::{Answer, Envelope, Payload, attach_candidate};
use crate::protocol::rejected::RejectedMessage;

#[cfg(test)]
mod tests;

/// Decodes the bytes as a request to the server and as an answer to a walker, and encodes each again; `None` where the
/// bytes are rejected.
pub fn reencode(bytes: &[u8]) -> [Option<Vec<u8>>; 2] {
    [request(bytes).ok(), answer(bytes).ok()]
}

fn request(bytes: &[u8]) -> Result<Vec<u8>, RejectedMessage> {
    let (control, block) = frame::split(bytes)?;
    let Envelope { sender, payload } = decode(control)?;
    let Payload::Offer { sequence, report } = payload else {
        return Ok(encode_message(&Envelope { sender, payload }, None));
    };
    let block = if block.is_empty() { None } else { Some(CandidateBlock::from_bytes(block)?) };
    let report = attach_candidate(report, block)?;
    let report = report.map(|report| report.map_candidate(|block| block.view().to_candidate()));
    let (payload, candidate) = Payload::offer(sequence, report.as_ref());
    Ok(encode_message(&Envelope { sender, payload }, candidate))
}

fn answer(bytes: &[u8]) -> Result<Vec<u8>, RejectedMessage> {
    let (control, _) = frame::split(bytes)?;
    Ok(encode_message(&Answer::decode(control)?, None))
}

fn encode_message(content: &impl Serialize, candidate: Option<&Candidate>) -> Vec<u8> {
    frame::to_words(&encode(content), candidate).as_bytes().to_vec()
}
