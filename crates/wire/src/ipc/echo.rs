//! What is understood of bytes, written as its sender would write it. Tests and the fuzz target look through this at all that
//! is done to a message before it is believed.

use serde::Serialize;
use zerocopy::IntoBytes;

use crate::block::{Candidate, CandidateBlock};
use crate::control::{seal, unseal};
use crate::exchange::dropped::Dropped;
use crate::exchange::frame;
use crate::exchange::message::{Answer, Letter, Words, complete};

#[cfg(test)]
mod tests;

/// The bytes read as the server reads a request, and as a walker reads an answer; none where they are refused.
pub fn echo(bytes: &[u8]) -> [Option<Vec<u8>>; 2] {
    [request(bytes).ok(), answer(bytes).ok()]
}

fn request(bytes: &[u8]) -> Result<Vec<u8>, Dropped> {
    let (control, block) = frame::split(bytes)?;
    let Letter { caller, words } = unseal(control)?;
    let Words::Offer { sequence, report } = words else {
        return Ok(written(&Letter { caller, words }, None));
    };
    let block = if block.is_empty() { None } else { Some(CandidateBlock::from_bytes(block)?) };
    let report = complete(report, block)?;
    let report = report.map(|report| report.map_candidate(|block| block.view().to_candidate()));
    let (words, candidate) = Words::offer(sequence, report.as_ref());
    Ok(written(&Letter { caller, words }, candidate))
}

fn answer(bytes: &[u8]) -> Result<Vec<u8>, Dropped> {
    let (control, _) = frame::split(bytes)?;
    Ok(written(&Answer::decode(control)?, None))
}

fn written(content: &impl Serialize, candidate: Option<&Candidate>) -> Vec<u8> {
    frame::words(&seal(content), candidate).as_bytes().to_vec()
}
