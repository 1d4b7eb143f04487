//! BLAKE3 hashes of files.

use std::fs::File;
use std::path::Path;

use npz::NpzFile;

use crate::exit_status::CommandError;

/// The BLAKE3 hash of a file of any size, which is read piece by piece.
pub fn hash(path: &Path) -> std::io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(File::open(path)?)?;
    Ok(hasher.finalize().to_string())
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_has_the_hash_of_its_bytes() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        for length in [0, 1, 65_536, 200_001] {
            let bytes: Vec<u8> = (0..length).map(|k: u32| (k % 251) as u8).collect();
            std::fs::write(&path, &bytes).unwrap();
            assert_eq!(hash(&path).unwrap(), blake3::hash(&bytes).to_string());
        }
        assert!(hash(directory.path()).is_err());
    }
}
