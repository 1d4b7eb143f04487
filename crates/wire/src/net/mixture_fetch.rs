//! The parts of a mixture that an agent fetches. Uses no ports and no clock.

use std::sync::Arc;

use calm::Mixture;

use super::delta::DeltaReceiver;
use super::link_error::{LinkError, decode_reply, unexpected};
use super::message::{AgentReply, AgentRequest};

/// A version of the mixture that is being fetched, part by part; a delta if the orchestrator still has the base version.
pub(super) struct MixtureFetch {
    session: u64,
    base: Option<Arc<Mixture>>,
    wanted: u64,
    receiver: Option<DeltaReceiver>,
}

impl MixtureFetch {
    pub(super) fn new(session: u64, base: Option<Arc<Mixture>>, wanted: u64) -> Self {
        Self { session, base, wanted, receiver: None }
    }

    /// The request for the next part.
    pub(super) fn request(&self) -> AgentRequest<'static> {
        let have = self.base.as_ref().map(|base| base.version());
        let skip = self.receiver.as_ref().map_or(0, DeltaReceiver::received);
        AgentRequest::Mixture { session: self.session, have, wanted: self.wanted, skip }
    }

    /// Adds a part. Returns the mixture when it is complete.
    pub(super) fn receive(&mut self, answer: &[u8]) -> Result<Option<Mixture>, LinkError> {
        let AgentReply::Mixture(part) = decode_reply(answer)? else { return Err(unexpected("mixture")) };
        let mut receiver = match self.receiver.take() {
            Some(receiver) if receiver.is_next(&part) => receiver,
            // The orchestrator has discarded the base version in the meantime: start over without it.
            Some(_) => return Ok(None),
            None => DeltaReceiver::new(&part, self.base.as_deref().filter(|_| part.from.is_some()))?,
        };
        if receiver.add_part(&part)? {
            return Ok(Some(receiver.finish()?));
        }
        self.receiver = Some(receiver);
        Ok(None)
    }
}
