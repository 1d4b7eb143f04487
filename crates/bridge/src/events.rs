//! What a device's thread waits for.

use std::sync::mpsc::SyncSender;

use crate::call::{BondGeometry, Call};
use crate::process::ServerEvent;
use crate::recipient::Recipient;

/// An event of a device.
#[derive(Debug)]
pub(crate) enum DeviceEvent {
    /// A client calls.
    Call { client: u64, call: Result<Call, String>, recipient: Recipient },
    /// A server has sent a line, or has ended.
    Server { generation: u64, event: ServerEvent },
    /// Evaluate copies of a structure in batches of all sizes, so that programs are compiled and memory is known. `done` gets whether each
    /// copy has the same bits.
    WarmUp { geometry: BondGeometry, most: usize, done: SyncSender<Result<bool, String>> },
    /// The device ends.
    Close,
}
