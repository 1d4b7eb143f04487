//! The division of labelled structures into training and validation.

use std::collections::BTreeMap;

use calm::build::shuffled;

use crate::data::{LabelledFrame, TrainingData};
use crate::error::UpfitError;

/// Stands for the split among the uses of the random seed; epochs have the numbers from 0.
const SPLIT: u64 = u64::MAX;

/// Takes about this share of the frames for validation: whole groups (seed structures) in random order, each that still fits.
/// The choice is a function of the order of the groups and of `seed`. With a share of 0 there is no validation.
///
/// # Errors
/// No frames; no group that fits, so that the validation set would be empty; no frames left to train with.
pub fn split(frames: Vec<LabelledFrame>, share: f64, seed: u64) -> Result<TrainingData, UpfitError> {
    if frames.is_empty() {
        return Err(UpfitError::NoFrames);
    }
    if share == 0.0 {
        return Ok(TrainingData { training: frames, validation: Vec::new() });
    }
    let groups = groups(&frames);
    let all = frames.len();
    let limit = (share * all as f64).ceil() as usize;
    let mut is_validation = vec![false; all];
    let mut taken = 0;
    for group in shuffled(seed, SPLIT, groups.len()) {
        let members = &groups[group];
        if taken + members.len() <= limit {
            taken += members.len();
            members.iter().for_each(|&frame| is_validation[frame] = true);
        }
    }
    if taken == 0 {
        let smallest = groups.iter().map(Vec::len).min().unwrap_or_default();
        return Err(UpfitError::NoValidation { share, limit, frames: all, groups: groups.len(), smallest });
    }
    if taken == all {
        return Err(UpfitError::NoTraining { share, frames: all });
    }
    let mut data = TrainingData::default();
    for (frame, is_validation) in frames.into_iter().zip(is_validation) {
        if is_validation { data.validation.push(frame) } else { data.training.push(frame) }
    }
    Ok(data)
}

/// Indices of the frames of each group, in the order in which the groups come.
fn groups(frames: &[LabelledFrame]) -> Vec<Vec<usize>> {
    let (mut known, mut groups) = (BTreeMap::new(), Vec::<Vec<usize>>::new());
    for (index, frame) in frames.iter().enumerate() {
        let group = *known.entry(frame.group.as_str()).or_insert(groups.len());
        match groups.get_mut(group) {
            Some(members) => members.push(index),
            None => groups.push(vec![index]),
        }
    }
    groups
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_frames::aluminium;

    /// Frames that differ in their places, with these groups.
    fn frames(groups: &[&str]) -> Vec<LabelledFrame> {
        let frame = aluminium(1).remove(0);
        let named = |(index, group): (usize, &&str)| LabelledFrame {
            place: index.to_string(),
            group: (*group).to_owned(),
            ..frame.clone()
        };
        groups.iter().enumerate().map(named).collect()
    }

    #[test]
    fn groups_stay_together() {
        let names: Vec<_> = (0..40).map(|k| ["a", "b", "c", "d", "e", "f", "g", "h"][k % 8]).collect();
        let mut chosen = Vec::new();
        for seed in 0..20 {
            let data = split(frames(&names), 0.25, seed).unwrap();
            assert_eq!((data.training.len(), data.validation.len()), (30, 10));
            let of = |frames: &[LabelledFrame]| -> Vec<String> {
                frames.iter().map(|frame| frame.group.clone()).collect()
            };
            let (training, validation) = (of(&data.training), of(&data.validation));
            assert!(validation.iter().all(|group| !training.contains(group)));
            assert_eq!(data, split(frames(&names), 0.25, seed).unwrap());
            chosen.push(validation);
        }
        chosen.sort();
        chosen.dedup();
        assert!(chosen.len() > 3, "{chosen:?}");
    }

    #[test]
    fn empty_sets_are_refused() {
        let message = |groups: &[&str], share| split(frames(groups), share, 1).unwrap_err().to_string();
        let empty = message(&["a"; 20], 0.1);
        assert!(empty.contains("the validation set is empty") && empty.contains("has 20"), "{empty}");
        assert!(message(&["a", "b"], 0.9).contains("the training set is empty"));
        assert!(message(&[], 0.1).contains("no labelled structures"));
        assert!(split(frames(&["a"]), 0.0, 1).unwrap().validation.is_empty());
    }
}
