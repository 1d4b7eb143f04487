//! BLAKE3 hashes of files.

use std::fs;
use std::path::Path;

use npz::NpzFile;

use crate::exit_status::CommandError;

/// The BLAKE3 hash of a file.
pub fn hash(path: &Path) -> std::io::Result<String> {
    Ok(blake3::hash(&fs::read(path)?).to_string())
}

/// The BLAKE3 hash of a model's weights and projection matrix: that of its export without the arrays of a mixture.
///
/// # Errors
/// A file that is no archive of numbers and texts.
pub fn model_hash(path: &Path) -> Result<String, CommandError> {
    let file = NpzFile::open(path).map_err(CommandError::input)?;
    let mut hasher = blake3::Hasher::new();
    let keys = file.names().filter(|key| !key.starts_with("uq_") || *key == "uq_rp_matrix");
    for key in keys {
        hasher.update(format!("{key}\n").as_bytes());
        match file.numbers(key) {
            Ok(found) => {
                hasher.update(format!("{:?}\n", found.shape).as_bytes());
                for number in found.data {
                    hasher.update(&number.to_le_bytes());
                }
            }
            Err(_) => {
                let texts = file.strings(key).map_err(CommandError::input)?;
                hasher.update(format!("{texts:?}\n").as_bytes());
            }
        }
    }
    Ok(hasher.finalize().to_string())
}

/// Checks that a file has this BLAKE3 hash.
pub fn verify_hash(path: &Path, expected: &str) -> Result<(), CommandError> {
    let found = hash(path)
        .map_err(|error| CommandError::Input(format!("cannot read {}: {error}", path.display())))?;
    if found == expected {
        return Ok(());
    }
    Err(CommandError::Input(format!(
        "{}: the file has another content (BLAKE3 {found}) than when this run began ({expected}); restore the old file",
        path.display()
    )))
}
