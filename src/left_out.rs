//! Structures that a command leaves out because they cannot be graded.

use std::fmt::Display;

use crate::exit_status::CommandError;
use crate::output::{count, log_and_warn};

/// How many they are, and the first one with its place and the reason.
#[derive(Debug, Default)]
pub struct LeftOutStructures {
    count: u64,
    first: String,
}

impl LeftOutStructures {
    /// Adds a structure.
    pub fn add(&mut self, place: impl Display, reason: impl Display) {
        if self.count == 0 {
            self.first = format!("{place}: {reason}");
        }
        self.count += 1;
    }

    /// How many they are.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Warns of them, if there are any. `kept` is the number of the others.
    ///
    /// # Errors
    /// All structures were left out.
    pub fn warn(&self, kept: u64) -> Result<(), CommandError> {
        match (self.count, kept) {
            (0, _) => (),
            (_, 0) => return Err(CommandError::Input(format!("no structure can be graded; {}", self.first))),
            _ => log_and_warn(format_args!(
                "left out {} that cannot be graded; the first: {}",
                count(self.count, "structure"),
                self.first
            )),
        }
        Ok(())
    }
}
