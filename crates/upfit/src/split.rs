//! The division of labelled structures into training and validation.

use std::collections::BTreeMap;

use calm::build::shuffled;

use crate::data::{LabelledFrame, TrainingData};
use crate::error::UpfitError;

/// Stands for the split among the uses of the random seed; epochs have the numbers from 0.
const SPLIT: u64 = u64::MAX;

/// Takes about this share of the frames for validation: whole groups (seed structures) in random order, each that still fits, but
/// not all. If none fits, the smallest group is taken, the first such in that order. The choice is a function of the order of the
/// groups and of `seed`. With a share of 0 there is no validation.
///
/// # Errors
/// No frames; a single group, which cannot be divided.
pub fn split(frames: Vec<LabelledFrame>, share: f64, seed: u64) -> Result<TrainingData, UpfitError> {
    if frames.is_empty() {
        return Err(UpfitError::NoFrames);
    }
    if share == 0.0 {
        return Ok(TrainingData { training: frames, validation: Vec::new() });
    }
    let groups = groups(&frames);
    if groups.len() < 2 {
        let (structures, group) = (frames.len(), frames[0].group.clone());
        return Err(UpfitError::OneGroup { share, structures, group });
    }
    let mut is_validation = vec![false; frames.len()];
    for group in held_out(&groups, share, seed) {
        groups[group].iter().for_each(|&frame| is_validation[frame] = true);
    }
    let mut data = TrainingData::default();
    for (frame, is_validation) in frames.into_iter().zip(is_validation) {
        if is_validation { data.validation.push(frame) } else { data.training.push(frame) }
    }
    Ok(data)
}

/// Indices of the groups for validation, of two or more: at least one, and not all.
fn held_out(groups: &[Vec<usize>], share: f64, seed: u64) -> Vec<usize> {
    let all: usize = groups.iter().map(Vec::len).sum();
    let limit = ((share * all as f64).ceil() as usize).min(all - 1);
    let order = shuffled(seed, SPLIT, groups.len());
    let mut taken = 0;
    let fits = |&group: &usize| {
        let with_it = taken + groups[group].len();
        let fits = with_it <= limit;
        taken = if fits { with_it } else { taken };
        fits
    };
    let fitting: Vec<_> = order.iter().copied().filter(fits).collect();
    if fitting.is_empty() {
        return order.into_iter().min_by_key(|&group| groups[group].len()).into_iter().collect();
    }
    fitting
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
    fn the_smallest_group_is_held_out_if_none_fits() {
        for seed in 0..10 {
            let data = split(frames(&["a", "a", "a", "b", "b", "c", "c", "c"]), 0.1, seed).unwrap();
            let held: Vec<_> = data.validation.iter().map(|frame| frame.place.as_str()).collect();
            assert_eq!((held, data.training.len()), (vec!["3", "4"], 6));
            // The largest share leaves a group to train with.
            let data = split(frames(&["a", "b"]), 0.9, seed).unwrap();
            assert_eq!((data.training.len(), data.validation.len()), (1, 1));
        }
    }

    #[test]
    fn a_single_group_is_refused() {
        let message = |groups: &[&str], share| split(frames(groups), share, 1).unwrap_err().to_string();
        let one = message(&["fcc"; 20], 0.1);
        assert!(one.contains("20 structures belong to one seed structure, fcc;"), "{one}");
        assert!(one.contains("expected at least 2 to hold out a share of 0.1"), "{one}");
        assert!(message(&[], 0.1).contains("no labelled structures"));
        assert!(split(frames(&["a"]), 0.0, 1).unwrap().validation.is_empty());
    }
}
