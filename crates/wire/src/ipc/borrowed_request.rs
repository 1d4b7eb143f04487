//! A request that the server keeps: the route of its answer, and the owner of the candidate in it.

use std::ptr::NonNull;
use std::sync::{Mutex, PoisonError};

use zerocopy::IntoBytes;

use super::IpcError;
use super::config::Request;
use crate::protocol::frame::{self, FrameError};

/// A request with the places of its parts. The memory under them stays mapped as long as the request is kept, also when
/// the walker that wrote it is dead and cleaned away.
pub(super) struct BorrowedRequest {
    /// Behind a lock, because iceoryx2 lets a request be sent to another thread but not be shared.
    request: Mutex<Request>,
    control: NonNull<[u8]>,
    block: NonNull<[u8]>,
}

// SAFETY: the pointers lead into memory that `request` keeps mapped, that nobody moves, and that no thread of this
// process writes to; whoever has a `&BorrowedRequest` can only read through them. The walker could still write to it: it is a
// program of the same user that is trusted not to, as with a debugger (see `super`). What it sent is checked once, with
// the lengths that are kept from then on, so that no later write leads out of the request.
#[allow(unsafe_code)]
unsafe impl Send for BorrowedRequest {}
// SAFETY: as above; the request itself is behind a lock.
#[allow(unsafe_code)]
unsafe impl Sync for BorrowedRequest {}

impl BorrowedRequest {
    /// Finds the parts of a request. The length is read once, here, and not trusted to stay what it is.
    pub(super) fn new(request: Request) -> Result<Self, FrameError> {
        let (control, block) = frame::split(request.payload().as_bytes())?;
        let (control, block) = (NonNull::from(control), NonNull::from(block));
        Ok(Self { request: Mutex::new(request), control, block })
    }

    /// The control message.
    #[allow(unsafe_code)]
    pub(super) fn control(&self) -> &[u8] {
        // SAFETY: made from a reference into the request's memory, which is mapped as long as `self.request` lives.
        unsafe { self.control.as_ref() }
    }

    /// The candidate block; empty if there is none.
    #[allow(unsafe_code)]
    pub(super) fn block(&self) -> &[u8] {
        // SAFETY: as in `control`.
        unsafe { self.block.as_ref() }
    }

    /// Answers the request. An answer may be lost without an error; the walker asks for it then.
    pub(super) fn answer(&self, control: &[u8]) -> Result<(), IpcError> {
        let words = frame::to_words(control, None);
        let request = self.request.lock().unwrap_or_else(PoisonError::into_inner);
        let memory = request.loan_slice_uninit(words.len());
        let memory = memory.map_err(|e| IpcError::new("find memory for an answer", e))?;
        memory.write_from_slice(&words).send().map_err(|e| IpcError::new("send an answer", e))
    }
}

impl AsRef<[u8]> for BorrowedRequest {
    fn as_ref(&self) -> &[u8] {
        self.block()
    }
}
