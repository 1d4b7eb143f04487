//! What determines the result of a training, to recognise its checkpoint.

use potentials::grace::TrainableGrace;

use crate::data::{TrainingData, data_hash};
use crate::settings::UpfitSettings;

/// Names and values of what determines the result.
pub fn identity(
    model: &TrainableGrace,
    data: &TrainingData,
    settings: &UpfitSettings,
) -> Vec<(String, String)> {
    let mut entries = vec![
        ("model (BLAKE3 of its file)".to_owned(), blake3::hash(model.file_bytes()).to_string()),
        ("training set (BLAKE3)".to_owned(), data_hash(&data.training)),
        ("validation set (BLAKE3)".to_owned(), data_hash(&data.validation)),
    ];
    entries.extend(settings.entries());
    entries
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_frames::{aluminium, model, settings};

    #[test]
    fn every_number_of_the_model_file_counts() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("model.npz");
        // The same weights, and another note.
        model().write(&path, "a note").unwrap();
        let other = TrainableGrace::load(&path).unwrap();
        assert_eq!(other.weights(), model().weights());
        let data = TrainingData { training: aluminium(1), validation: Vec::new() };
        let [of_model, of_other] = [model(), other].map(|model| identity(&model, &data, &settings()));
        assert_ne!(of_model[0], of_other[0]);
        assert_eq!(of_model[1..], of_other[1..]);
    }
}
