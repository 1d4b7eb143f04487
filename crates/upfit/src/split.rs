//! The division of labelled structures into training and validation.

use std::collections::BTreeMap;

use calm::build::shuffled;

use crate::data::{LabelledFrame, TrainingData};
use crate::error::UpfitError;

/// Stands for the split among the uses of the random seed; epochs have the numbers from 0.
const SPLIT: u64 = u64::MAX;

/// The most that a part of the frames may lose to validation, if the share asked for is smaller.
const MAX_LOST: f64 = 0.25;

/// Takes about this share of the frames for validation: whole groups (seed structures) in random order, each that still fits, but
/// not all. If none fits, the smallest group is taken, the first such in that order. Each file is divided by itself, so that a large
/// file of small groups does not take the place of a small one of large groups. Files of which the share is less than one frame are
/// divided together, and so are those with a single group. A part whose smallest group is more than a quarter of it is left whole, unless that is so
/// of all. The choice is a function of the order of the groups and of `seed`. With a
/// share of 0 there is no validation.
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
    let parts = parts(&groups, share);
    let held: Vec<_> = (0..=SPLIT)
        .rev()
        .zip(&parts)
        .map(|(stream, part)| {
            let held = held_out(part, share, (seed, stream));
            (number_of_frames(&held) as f64 / number_of_frames(part) as f64, held)
        })
        .collect();
    // A part of few large groups loses none of them if there is another part to validate with.
    let least = held.iter().map(|(lost, _)| *lost).fold(f64::INFINITY, f64::min);
    let bearable = held.into_iter().filter(|(lost, _)| *lost <= MAX_LOST.max(share).max(least));
    for group in bearable.flat_map(|(_, held)| held) {
        group.frames.iter().for_each(|&frame| is_validation[frame] = true);
    }
    let mut data = TrainingData::default();
    for (frame, is_validation) in frames.into_iter().zip(is_validation) {
        if is_validation { data.validation.push(frame) } else { data.training.push(frame) }
    }
    Ok(data)
}

/// Frames that stay together.
struct FrameGroup {
    /// The file of the first of them.
    file: usize,
    /// Their indices.
    frames: Vec<usize>,
}

/// The groups that are divided by themselves: those of each large file, and those of the small ones together. A part with a single
/// group is left out.
fn parts(groups: &[FrameGroup], share: f64) -> Vec<Vec<&FrameGroup>> {
    let mut files = BTreeMap::<usize, Vec<&FrameGroup>>::new();
    groups.iter().for_each(|group| files.entry(group.file).or_default().push(group));
    let is_large = |part: &[&FrameGroup]| part.len() > 1 && share * number_of_frames(part) as f64 >= 1.0;
    let (mut parts, small): (Vec<_>, Vec<_>) = files.into_values().partition(|part| is_large(part));
    parts.push(small.concat());
    parts.retain(|part| part.len() > 1);
    parts
}

fn number_of_frames(groups: &[&FrameGroup]) -> usize {
    groups.iter().map(|group| group.frames.len()).sum()
}

/// Those of two or more groups for validation: at least one, and not all. `random` is the random seed and its use.
fn held_out<'a>(groups: &[&'a FrameGroup], share: f64, random: (u64, u64)) -> Vec<&'a FrameGroup> {
    let all = number_of_frames(groups);
    let limit = ((share * all as f64).ceil() as usize).min(all - 1);
    let (seed, stream) = random;
    let order: Vec<_> = shuffled(seed, stream, groups.len()).into_iter().map(|index| groups[index]).collect();
    let mut taken = 0;
    let fits = |group: &&FrameGroup| {
        let with_it = taken + group.frames.len();
        let fits = with_it <= limit;
        taken = if fits { with_it } else { taken };
        fits
    };
    let fitting: Vec<_> = order.iter().copied().filter(fits).collect();
    if fitting.is_empty() {
        return order.into_iter().min_by_key(|group| group.frames.len()).into_iter().collect();
    }
    fitting
}

/// The groups, in the order in which they come.
fn groups(frames: &[LabelledFrame]) -> Vec<FrameGroup> {
    let (mut known, mut groups) = (BTreeMap::new(), Vec::<FrameGroup>::new());
    for (index, frame) in frames.iter().enumerate() {
        let group = *known.entry(frame.group.as_str()).or_insert(groups.len());
        match groups.get_mut(group) {
            Some(group) => group.frames.push(index),
            None => groups.push(FrameGroup { file: frame.file, frames: vec![index] }),
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

    /// These numbers of frames in groups of these sizes, a file each.
    fn files(all: &[(usize, usize)]) -> Vec<LabelledFrame> {
        let frame = aluminium(1).remove(0);
        let of_file = |(file, &(frames, size)): (usize, &(usize, usize))| {
            let frame = frame.clone();
            (0..frames).map(move |number| LabelledFrame {
                place: format!("{file}:{number}"),
                group: format!("{file}: {}", number / size),
                file,
                ..frame.clone()
            })
        };
        all.iter().enumerate().flat_map(of_file).collect()
    }

    /// Number of frames of each file for validation.
    fn held_out_by_file(all: &[(usize, usize)], share: f64, seed: u64) -> Vec<usize> {
        let data = split(files(all), share, seed).unwrap();
        let of = |file| data.validation.iter().filter(|frame| frame.file == file).count();
        (0..all.len()).map(of).collect()
    }

    /// Replay data of single frames, and few seed structures with many labels each.
    #[test]
    fn validation_has_structures_of_each_file() {
        for seed in 0..20 {
            for (replay, labels, expected) in [
                ((50, 1), (54, 9), [5, 9]),
                ((200, 1), (80, 10), [20, 10]),
                ((40, 1), (60, 15), [4, 15]),
                ((40, 1), (200, 10), [4, 20]),
                // Few large ones lose too much.
                ((1000, 1), (30, 15), [100, 0]),
                ((40, 1), (8, 4), [4, 0]),
                // A single seed structure is not divided.
                ((40, 1), (30, 30), [4, 0]),
            ] {
                assert_eq!(held_out_by_file(&[replay, labels], 0.1, seed), expected, "{replay:?} {labels:?}");
            }
            // Small files together lose the share too, and no more.
            let held: usize = held_out_by_file(&[(2, 1); 20], 0.1, seed).iter().sum();
            assert_eq!(held, 4);
            let held: usize = held_out_by_file(&[(1, 1); 30], 0.1, seed).iter().sum();
            assert_eq!(held, 3);
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
