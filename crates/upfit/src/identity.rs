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
    let mut hasher = blake3::Hasher::new();
    for group in model.groups() {
        hasher.update(format!("{} {:?}\n", group.name, group.shape).as_bytes());
    }
    for weight in model.weights() {
        hasher.update(&weight.to_le_bytes());
    }
    let mut entries = vec![
        ("model (BLAKE3 of its weights)".to_owned(), hasher.finalize().to_string()),
        ("training set (BLAKE3)".to_owned(), data_hash(&data.training)),
        ("validation set (BLAKE3)".to_owned(), data_hash(&data.validation)),
    ];
    entries.extend(settings.entries());
    entries
}
