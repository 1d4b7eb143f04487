//! Locates executables.

use std::path::{Path, PathBuf};

use crate::SetupError;

/// Finds a program: an absolute path is used as is, a name is looked up in PATH.
///
/// # Errors
/// [`SetupError::Program`] if there is no such file.
pub(crate) fn find(name: &str) -> Result<PathBuf, SetupError> {
    let fault = |reason: &str| SetupError::Program { program: name.to_owned(), reason: reason.to_owned() };
    if Path::new(name).is_absolute() {
        let file = PathBuf::from(name);
        return if file.is_file() { Ok(file) } else { Err(fault("there is no such file")) };
    }
    if name.is_empty() || name.contains('/') {
        return Err(fault("expected an absolute path, or a name to look up in PATH"));
    }
    let directories = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&directories)
        .map(|directory| directory.join(name))
        .find(|file| file.is_file())
        .ok_or_else(|| {
            fault(
                "not found in any directory of PATH; install it, load its module, or give its absolute path",
            )
        })
}
