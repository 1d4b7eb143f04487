//! BLAKE3 hashes of files.

use std::fs;
use std::path::Path;

use crate::exit_status::Failure;

/// The BLAKE3 hash of a file.
pub fn hash(path: &Path) -> std::io::Result<String> {
    Ok(blake3::hash(&fs::read(path)?).to_string())
}

/// Checks that a file has this BLAKE3 hash.
pub fn verify_hash(path: &Path, expected: &str) -> Result<(), Failure> {
    let found =
        hash(path).map_err(|error| Failure::Input(format!("cannot read {}: {error}", path.display())))?;
    if found == expected {
        return Ok(());
    }
    Err(Failure::Input(format!(
        "{}: the file has another content (BLAKE3 {found}) than when this run began ({expected}); restore the old file",
        path.display()
    )))
}
