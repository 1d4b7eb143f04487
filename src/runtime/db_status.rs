//! Reports once when the database becomes unreachable, and once when it answers again.

use store::StoreError;

use crate::output::{log_and_print, log_and_warn};

/// Whether the database was reachable at the last attempt.
#[derive(Debug, Default)]
pub struct DbStatus {
    unreachable: bool,
}

impl DbStatus {
    /// Takes the result of a write.
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
