//! The size of batches that the memory of a device takes, kept for the next start beside what frameworks compile.
//!
//! It holds for one model on one device, with the same versions of its framework.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use tempfile::NamedTempFile;

use crate::description::ModelDescription;
use crate::settings::PythonSettings;

/// Characters of the hash of model, adapter, precision and device in the file's name.
const NAME_HASH: usize = 16;

/// What a size was found for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct LimitSubject {
    identity: String,
    device: String,
    adapter: String,
    versions: BTreeMap<String, String>,
    precision: String,
}

/// What the file has.
#[derive(Serialize, Deserialize)]
struct KeptLimit {
    #[serde(flatten)]
    subject: LimitSubject,
    /// Largest number of structures of a batch when the size was found.
    max_batch: u32,
    /// Largest number of bonds of a batch of several structures.
    max_bonds: usize,
}

/// The file of a device.
#[derive(Debug)]
pub(crate) struct LimitFile {
    path: PathBuf,
    subject: LimitSubject,
    max_batch: u32,
}

impl LimitFile {
    /// The file of a device, if there is a directory for it.
    pub fn new(settings: &PythonSettings, description: &ModelDescription) -> Option<Self> {
        let directory = settings.cache.as_ref()?;
        let ModelDescription { identity, device, adapter, versions, precision, .. } = description.clone();
        let hash = blake3::hash(
            [&identity, &adapter, &precision, &device].map(|one| format!("{one}\n")).concat().as_bytes(),
        );
        let path = directory.join(format!("calmwalk-batch-{}.json", &hash.to_hex()[..NAME_HASH]));
        let subject = LimitSubject { identity, device, adapter, versions, precision };
        Some(Self { path, subject, max_batch: settings.max_batch.get() })
    }

    /// Where it is.
    pub fn path(&self) -> &PathBuf {
        &self.path
    }

    /// The kept size, bonds. `None` if there is none, if it is of something else, or if larger batches are wanted now than when it was
    /// found.
    pub fn read(&self) -> Option<usize> {
        let kept: KeptLimit = serde_json::from_str(&fs::read_to_string(&self.path).ok()?).ok()?;
        (kept.subject == self.subject && kept.max_batch >= self.max_batch).then_some(kept.max_bonds)
    }

    /// Keeps a size, bonds.
    ///
    /// # Errors
    /// A directory that cannot be written.
    pub fn write(&self, max_bonds: usize) -> io::Result<()> {
        let kept = KeptLimit { subject: self.subject.clone(), max_batch: self.max_batch, max_bonds };
        let directory = self.path.parent().unwrap_or(&self.path);
        fs::create_dir_all(directory)?;
        let mut file = NamedTempFile::new_in(directory)?;
        file.write_all(serde_json::to_string_pretty(&kept)?.as_bytes())?;
        file.persist(&self.path)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU32;
    use std::path::Path;

    use super::*;
    use crate::same_model::tests::reference;

    fn file(directory: &Path, max_batch: u32, change: impl Fn(&mut ModelDescription)) -> LimitFile {
        let mut settings = PythonSettings::new(Path::new("/env"), "mace", None);
        settings.cache = Some(directory.join("cache"));
        settings.max_batch = NonZeroU32::new(max_batch).unwrap();
        let mut description = reference().description;
        change(&mut description);
        LimitFile::new(&settings, &description).unwrap()
    }

    #[test]
    fn a_size_is_kept_for_the_same_model_device_and_versions() {
        let directory = tempfile::tempdir().unwrap();
        let here = |max_batch| file(directory.path(), max_batch, |_| {});
        assert_eq!(here(32).read(), None);
        here(32).write(4000).unwrap();
        assert_eq!([16, 32, 33].map(|most| here(most).read()), [Some(4000), Some(4000), None]);
        let other = |change: fn(&mut ModelDescription)| file(directory.path(), 32, change).read();
        // These are kept beside each other.
        let changes: [fn(&mut ModelDescription); 4] = [
            |description| description.device = "cuda:1".to_owned(),
            |description| description.precision = "single".to_owned(),
            |description| description.adapter = "mace.py:Mace".to_owned(),
            |description| description.identity.push('c'),
        ];
        for change in changes {
            assert_eq!(other(change), None);
            assert_ne!(file(directory.path(), 32, change).path(), here(32).path());
        }
        assert_eq!(
            other(|description| drop(description.versions.insert("torch".into(), "2.7".into()))),
            None
        );
        assert_eq!(other(|description| description.identity.push('b')), None);
        fs::write(here(32).path(), "{").unwrap();
        assert_eq!(here(32).read(), None);
        here(32).write(2000).unwrap();
        assert_eq!(here(32).read(), Some(2000));
    }
}
