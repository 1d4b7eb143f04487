//! Whether the database answers: said once when it does not, and once when it does again.

use store::StoreError;

use crate::output::{say, warn};

/// What is known of it.
#[derive(Debug, Default)]
pub struct Answers {
    awaited: bool,
}

impl Answers {
    /// Somebody has tried to write to it.
    pub fn tried(&mut self, written: &Result<(), StoreError>) {
        match written {
            Err(error) if error.is_transient() => {
                if !std::mem::replace(&mut self.awaited, true) {
                    warn(format_args!("waiting for the database: {error}"));
                }
            }
            _ => {
                if std::mem::take(&mut self.awaited) {
                    say("the database answers again");
                }
            }
        }
    }
}
