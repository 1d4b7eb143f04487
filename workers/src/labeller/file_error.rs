//! Errors of files.

use std::io;
use std::path::Path;

use store::StoreError;

/// An error that fails the labeller and not the job: another host may be able to run it.
pub(super) fn file_error(path: &Path, source: io::Error) -> StoreError {
    StoreError::File { path: path.to_owned(), source }
}
