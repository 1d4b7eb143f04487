//! Chooses the frames of a data set of any size whose atoms are monitored.

use std::collections::BTreeMap;
use std::path::Path;

use atoms::Species;

use crate::xyz_reader::XyzReader;

/// Number of atoms of each element that are enough for the share above 1 to 1 or 2 percent.
const ATOMS_PER_ELEMENT: usize = 500;

/// Number of atoms in all that are always taken, if the data set has them.
const MIN_ATOMS: usize = 4000;

/// Whether each frame of a file belongs to the sample. Reads the file frame by frame. Frames with rare elements come
/// first; those of an element are spread evenly over the file.
pub fn select(path: &Path) -> Result<Vec<bool>, String> {
    let mut frames = Vec::new();
    for frame in XyzReader::open(path).map_err(|error| error.to_string())? {
        let frame = frame.map_err(|error| error.to_string())?;
        let mut counts: BTreeMap<Species, usize> = BTreeMap::new();
        for species in frame.structure.species {
            *counts.entry(species).or_default() += 1;
        }
        frames.push(counts.into_iter().collect::<Vec<_>>());
    }
    if frames.iter().all(Vec::is_empty) {
        return Err(format!("{}: found no frames with atoms, expected at least one", path.display()));
    }
    Ok(select_from(&frames))
}

/// The same for frames with these numbers of atoms of each element.
fn select_from(frames: &[Vec<(Species, usize)>]) -> Vec<bool> {
    let mut with: BTreeMap<Species, (usize, Vec<usize>)> = BTreeMap::new();
    for (frame, counts) in frames.iter().enumerate() {
        for &(species, count) in counts {
            let (atoms, frames) = with.entry(species).or_default();
            *atoms += count;
            frames.push(frame);
        }
    }
    let wanted = ATOMS_PER_ELEMENT.max(MIN_ATOMS / with.len().max(1));
    let mut by_abundance: Vec<_> = with.into_iter().collect();
    by_abundance.sort_by_key(|(species, (atoms, _))| (*atoms, *species));
    let mut selected = vec![false; frames.len()];
    for (species, (_, of_element)) in by_abundance {
        let count = |frame: usize| {
            let found = frames[frame].iter().find(|(other, _)| *other == species);
            found.map_or(0, |(_, count)| *count)
        };
        let of = |frames: &[usize]| frames.iter().map(|frame| count(*frame)).sum::<usize>();
        let (taken, left): (Vec<_>, Vec<_>) = of_element.into_iter().partition(|frame| selected[*frame]);
        let (needed, all) = (wanted.saturating_sub(of(&taken)), of(&left));
        // Frames follow at a rate that has the needed atoms when the last one has been seen.
        let (mut seen, mut found) = (0, 0);
        for frame in left {
            seen += count(frame);
            if found * all < needed * seen {
                selected[frame] = true;
                found += count(frame);
            }
        }
    }
    selected
}

#[cfg(test)]
mod tests {
    use super::*;

    fn species(symbol: &str) -> Species {
        symbol.parse().unwrap()
    }

    fn atoms_of(frames: &[Vec<(Species, usize)>], selected: &[bool], symbol: &str) -> usize {
        let taken =
            frames.iter().zip(selected).filter(|(_, selected)| **selected).flat_map(|(frame, _)| frame);
        taken.filter(|(other, _)| *other == species(symbol)).map(|(_, count)| count).sum()
    }

    #[test]
    fn rare_elements_are_sampled_as_well_as_frequent_ones() {
        // 20 000 frames of oxygen, one in 100 of them with hydrogen, three with uranium.
        let frame = |number: usize| {
            let mut counts = vec![(species("O"), 40)];
            counts.extend((number % 100 == 7).then(|| (species("H"), 10)));
            counts.extend((number % 8000 == 5).then(|| (species("U"), 2)));
            counts
        };
        let frames: Vec<_> = (0..20_000).map(frame).collect();
        let selected = select_from(&frames);
        let atoms = ["O", "H", "U"].map(|symbol| atoms_of(&frames, &selected, symbol));
        assert_eq!(atoms[2], 6, "all there are");
        assert!((1333..1400).contains(&atoms[1]), "{atoms:?}");
        assert!(atoms[0] < 40 * 140 + 100, "{atoms:?}");
        // Spread over the file.
        let places: Vec<_> = (0..frames.len()).filter(|frame| selected[*frame]).collect();
        assert!(places[places.len() / 2].abs_diff(10_000) < 2000, "{places:?}");
    }

    #[test]
    fn a_small_data_set_is_taken_whole() {
        let frames = vec![vec![(species("Al"), 108)]; 30];
        assert_eq!(select_from(&frames), [true; 30]);
        let frames = vec![vec![(species("Al"), 108)]; 50];
        assert_eq!(select_from(&frames).iter().filter(|selected| **selected).count(), 38, "4000 atoms");
    }
}
