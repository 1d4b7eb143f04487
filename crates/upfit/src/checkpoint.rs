//! The state of a training on disk, from which it continues to the same bits.
//!
//! A file is a line that names the format, the BLAKE3 hash of the rest (32 bytes), and the rest in postcard's encoding: names
//! and values that identify the training, then its state. It appears complete, by renaming.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::differences::FrameDifferences;
use crate::energy_deviations::EnergyDeviations;
use crate::energy_zero::EnergyZero;
use crate::error::UpfitError;
use crate::optimiser::OptimiserState;
use crate::progress::{EpochRecord, ErrorsBySet};

/// First line of a file. The number grows with each change of what follows, or of what a training makes of it.
const FORMAT: &[u8] = b"calmwalk upfit checkpoint 4\n";
const HASH_BYTES: usize = blake3::OUT_LEN;

/// The state is saved again once this many times the duration of the last time has passed: it costs at most 5 % of the time.
const PAUSE: u32 = 19;

/// Everything that a training needs to continue.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainingState {
    /// Finished epochs.
    pub epoch: u64,
    /// Finished batches of the epoch that follows.
    pub batch: u64,
    /// The weights.
    pub weights: Vec<f64>,
    /// Their moving average.
    pub average: Option<Vec<f64>>,
    /// The optimiser.
    pub optimiser: OptimiserState,
    /// Differences in the finished batches of the epoch.
    pub running: FrameDifferences,
    /// The weights with the smallest validation loss.
    pub best: Option<BestWeights>,
    /// The finished epochs.
    pub history: Vec<EpochRecord>,
    /// The zero of the energies.
    pub zero: EnergyZero,
    /// How the energies differ after it was moved.
    pub spread: EnergyDeviations,
    /// Errors before the first update.
    pub before: ErrorsBySet,
}

/// Weights with the smallest validation loss.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BestWeights {
    /// Number of epochs after which they were validated.
    pub epoch: u64,
    /// The stage of that loss. Losses of other stages are not compared with it.
    pub stage: usize,
    /// The loss.
    pub loss: f64,
    /// The weights.
    pub weights: Vec<f64>,
}

/// The file of a training.
pub struct CheckpointFile {
    path: PathBuf,
    /// Names and values that identify the training.
    identity: Vec<(String, String)>,
    /// When it was last saved, and how long that took.
    saved: Instant,
    cost: Duration,
}

impl CheckpointFile {
    /// The file at `path`, which may not exist yet, of the training with these names and values.
    pub fn new(path: &Path, identity: Vec<(String, String)>) -> Self {
        Self { path: path.to_owned(), identity, saved: Instant::now(), cost: Duration::ZERO }
    }

    /// The saved state, if the file exists.
    ///
    /// # Errors
    /// A file that cannot be read, is damaged, or belongs to another training.
    pub fn read(&self) -> Result<Option<TrainingState>, UpfitError> {
        let bytes = match fs::read(&self.path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(UpfitError::ReadCheckpoint { path: self.path.clone(), source }),
        };
        let damaged = |reason| UpfitError::Damaged { path: self.path.clone(), reason };
        let rest = bytes.strip_prefix(FORMAT);
        let rest =
            rest.ok_or_else(|| damaged("no checkpoint of calmwalk upfit, or one of another version"))?;
        let (hash, content) =
            rest.split_at_checked(HASH_BYTES).ok_or_else(|| damaged("damaged checkpoint"))?;
        if blake3::hash(content).as_bytes() != hash {
            return Err(damaged("damaged checkpoint"));
        }
        let (identity, state): (Vec<(String, String)>, TrainingState) =
            postcard::from_bytes(content).map_err(|_| damaged("damaged checkpoint"))?;
        self.check_identity(&identity)?;
        Ok(Some(state))
    }

    /// Replaces the saved state.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&mut self, state: &TrainingState) -> Result<(), UpfitError> {
        let begun = Instant::now();
        let written = self.write(state);
        written.map_err(|source| UpfitError::WriteCheckpoint { path: self.path.clone(), source })?;
        self.saved = Instant::now();
        self.cost = begun.elapsed();
        Ok(())
    }

    /// Whether enough time has passed to save again.
    pub fn is_due(&self) -> bool {
        self.saved.elapsed() >= PAUSE * self.cost
    }

    fn check_identity(&self, saved: &[(String, String)]) -> Result<(), UpfitError> {
        if saved == self.identity {
            return Ok(());
        }
        let differing = self.identity.iter().zip(saved).find(|(now, saved)| now != saved);
        let (name, saved, now) = match differing {
            Some((now, saved)) if now.0 == saved.0 => (now.0.clone(), saved.1.clone(), now.1.clone()),
            _ => {
                let count = |entries: &[(String, String)]| entries.len().to_string();
                ("number of settings".to_owned(), count(saved), count(&self.identity))
            }
        };
        Err(UpfitError::OtherTraining { path: self.path.clone(), name, saved, now })
    }

    fn write(&self, state: &TrainingState) -> io::Result<()> {
        let content = postcard::to_stdvec(&(&self.identity, state)).map_err(io::Error::other)?;
        let parent = self.path.parent().filter(|parent| !parent.as_os_str().is_empty());
        let directory = parent.unwrap_or(Path::new("."));
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let mut file =
            tempfile::Builder::new().prefix(&format!(".{name}.")).suffix(".part").tempfile_in(directory)?;
        file.write_all(FORMAT)?;
        file.write_all(blake3::hash(&content).as_bytes())?;
        file.write_all(&content)?;
        file.as_file().sync_all()?;
        file.persist(&self.path).map_err(|error| error.error)?;
        File::open(directory)?.sync_all()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adam::AdamState;
    use crate::loss::LossSettings;

    fn state() -> TrainingState {
        let mut adam = AdamState::new(2);
        let mut weights = vec![0.1, -2.0];
        adam.step(&mut weights, &[0.3, 1e-300], 0.01, &[false; 2]);
        let training = FrameDifferences::default().errors(&LossSettings::demo().stages[0].weights);
        TrainingState {
            epoch: 3,
            batch: 7,
            average: Some(weights.clone()),
            optimiser: OptimiserState::Adam(adam),
            running: FrameDifferences::default(),
            best: Some(BestWeights { epoch: 2, stage: 0, loss: 0.25, weights: weights.clone() }),
            weights,
            history: Vec::new(),
            zero: EnergyZero::default(),
            spread: EnergyDeviations::new(&[("data.extxyz:3", 7.0), ("a", 0.0), ("b", 0.0)]),
            before: ErrorsBySet { training, validation: None },
        }
    }

    fn identity(seed: &str) -> Vec<(String, String)> {
        [("model", "abc"), ("random seed", seed)].map(|(a, b)| (a.to_owned(), b.to_owned())).to_vec()
    }

    #[test]
    fn what_is_read_is_what_was_saved() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("run.upfit");
        let mut file = CheckpointFile::new(&path, identity("1"));
        assert_eq!(file.read().unwrap(), None);
        let mut state = state();
        file.save(&state).unwrap();
        assert_eq!(file.read().unwrap().as_ref(), Some(&state));
        state.batch = 8;
        file.save(&state).unwrap();
        assert_eq!(file.read().unwrap().as_ref(), Some(&state));
        // No temporary file is left.
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }

    #[test]
    fn another_training_and_damage_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("run.upfit");
        let mut file = CheckpointFile::new(&path, identity("1"));
        file.save(&state()).unwrap();
        let message = CheckpointFile::new(&path, identity("2")).read().unwrap_err().to_string();
        assert!(message.contains("its random seed is 1, now it is 2"), "{message}");

        let bytes = fs::read(&path).unwrap();
        for place in [0, FORMAT.len(), FORMAT.len() + HASH_BYTES, bytes.len() - 1] {
            let mut damaged = bytes.clone();
            damaged[place] ^= 1;
            fs::write(&path, damaged).unwrap();
            assert!(matches!(file.read(), Err(UpfitError::Damaged { .. })), "{place}");
        }
        fs::write(&path, &bytes[..FORMAT.len() + 5]).unwrap();
        assert!(matches!(file.read(), Err(UpfitError::Damaged { .. })));
        let nowhere = directory.path().join("missing/run.upfit");
        let written = CheckpointFile::new(&nowhere, identity("1")).save(&state());
        assert!(matches!(written, Err(UpfitError::WriteCheckpoint { .. })));
    }
}
