//! Whether the database answers: said once when it does not, and once when it does again.

use store::StoreError;

use crate::output::{log_and_print, log_and_warn};

/// What is known of it.
#[derive(Debug, Default)]
pub struct DbStatus {
    unreachable: bool,
}

impl DbStatus {
    /// Somebody has tried to write to it.
    pub fn observe(&mut self, written: &Result<(), StoreError>) {
        match written {
            Err(error) if error.is_transient() => {
                if !std::mem::replace(&mut self.unreachable, true) {
                    log_and_warn(format_args!("waiting for the database: {error}"));
                }
            }
            _ => {
                if std::mem::take(&mut self.unreachable) {
                    log_and_print("the database answers again");
                }
            }
        }
    }
}
