//! A request that the server keeps, to answer it and to read its candidate in place.

use std::ptr::NonNull;
use std::sync::{Mutex, PoisonError};

use zerocopy::IntoBytes;

use super::IpcError;
use super::config::IpcRequest;
use crate::protocol::frame::{self, FrameError};

/// A request and the slices of its parts. The memory stays mapped as long as this value lives, even if the walker that
/// wrote it is dead and cleaned up.
pub(super) struct BorrowedRequest {
    /// Behind a lock because the request type of iceoryx2 is `Send` but not `Sync`.
    request: Mutex<IpcRequest>,
    control: NonNull<[u8]>,
    block: NonNull<[u8]>,
}

// SAFETY: the pointers refer to memory that `request` keeps mapped, that does not move, and that no thread of this
// process writes; a `&BorrowedRequest` only reads through them. The walker could still write to it: it is a program of
// the same user and trusted not to (see `super`). The content is validated once, with the lengths kept from then on, so
// that no later write can lead to an access outside the request.
#[allow(unsafe_code)]
unsafe impl Send for BorrowedRequest {}
// SAFETY: see above; the request itself is behind a lock.
#[allow(unsafe_code)]
unsafe impl Sync for BorrowedRequest {}

impl BorrowedRequest {
    /// Locates the parts of a request. The length is read only here, since the walker could change it later.
    pub(super) fn new(request: IpcRequest) -> Result<Self, FrameError> {
        let (control, block) = frame::split(request.payload().as_bytes())?;
        let (control, block) = (NonNull::from(control), NonNull::from(block));
        Ok(Self { request: Mutex::new(request), control, block })
    }

    /// The control message.
    #[allow(unsafe_code)]
    pub(super) fn control(&self) -> &[u8] {
        // SAFETY: created from a reference into the request's memory, which is mapped as long as `self.request` lives.
        unsafe { self.control.as_ref() }
    }

    /// The candidate block, or empty.
    #[allow(unsafe_code)]
    pub(super) fn block(&self) -> &[u8] {
        // SAFETY: see `control`.
        unsafe { self.block.as_ref() }
    }

    /// Answers the request. The answer may be lost without an error; the walker then polls.
    pub(super) fn answer(&self, control: &[u8]) -> Result<(), IpcError> {
        let words = frame::to_words(control, None);
        let request = self.request.lock().unwrap_or_else(PoisonError::into_inner);
        let memory = request.loan_slice_uninit(words.len());
        let memory = memory.map_err(|e| IpcError::new("allocate an answer", e))?;
        memory.write_from_slice(&words).send().map_err(|e| IpcError::new("send an answer", e))
    }
}

impl AsRef<[u8]> for BorrowedRequest {
    fn as_ref(&self) -> &[u8] {
        self.block()
    }
}
