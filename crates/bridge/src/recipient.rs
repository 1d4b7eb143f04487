//! The way of a result back to who called, in this process or through shared memory.

use std::sync::mpsc::SyncSender;

use bytemuck::{cast_slice, cast_slice_mut};
use wire::ipc::IncomingCall;

use crate::error::CallError;

/// Who gets the result of a call.
#[derive(Debug)]
pub(crate) enum Recipient {
    /// A thread of this process.
    Channel(SyncSender<Result<Vec<f64>, CallError>>),
    /// Another process.
    Shared(IncomingCall),
}

/// First word of an answer in shared memory.
mod status {
    pub const OK: u64 = 0;
    pub const UNAVAILABLE: u64 = 1;
    pub const FAILED: u64 = 2;
}

impl Recipient {
    /// Gives the recipient `length` numbers, which `write` writes.
    pub fn answer(self, length: usize, write: impl FnOnce(&mut [f64])) {
        match self {
            Self::Channel(sender) => {
                let mut numbers = vec![0.0; length];
                write(&mut numbers);
                let _ = sender.send(Ok(numbers));
            }
            Self::Shared(call) => call.answer(1 + length, |words| {
                words[0] = status::OK;
                write(cast_slice_mut(&mut words[1..]));
            }),
        }
    }

    /// Gives the recipient an error.
    pub fn refuse(self, error: &CallError) {
        match self {
            Self::Channel(sender) => {
                let _ = sender.send(Err(error.clone()));
            }
            Self::Shared(call) => {
                let (status, message) = match error {
                    CallError::Unavailable(message) => (status::UNAVAILABLE, message),
                    CallError::Failed(message) => (status::FAILED, message),
                };
                let bytes = message.as_bytes();
                call.answer(2 + bytes.len().div_ceil(8), |words| {
                    words.fill(0);
                    (words[0], words[1]) = (status, bytes.len() as u64);
                    cast_slice_mut::<u64, u8>(&mut words[2..])[..bytes.len()].copy_from_slice(bytes);
                });
            }
        }
    }
}

/// Reads an answer in shared memory.
///
/// # Errors
/// The error that it carries, or that it is none.
pub(crate) fn read_answer(words: &[u64]) -> Result<Vec<f64>, CallError> {
    let message = || {
        let [length, bytes @ ..] = &words[1..] else { return String::new() };
        let bytes: &[u8] = cast_slice(bytes);
        let length = usize::try_from(*length).unwrap_or_default().min(bytes.len());
        String::from_utf8_lossy(&bytes[..length]).into_owned()
    };
    match words.first() {
        Some(&status::OK) => Ok(cast_slice(&words[1..]).to_vec()),
        Some(&status::FAILED) => Err(CallError::Failed(message())),
        Some(&status::UNAVAILABLE) => Err(CallError::Unavailable(message())),
        _ => Err(CallError::Unavailable("the device sent an answer without a status".to_owned())),
    }
}
