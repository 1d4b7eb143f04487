//! Chooses the atoms of a data set of any size that are monitored.

use std::collections::BTreeMap;
use std::path::Path;

use atoms::{Species, Structure};

use crate::xyz_reader::XyzReader;

/// Number of atoms of each element that are enough for the share above 1 to 1 or 2 percent.
const ATOMS_PER_ELEMENT: usize = 500;

/// Number of atoms in all that are always taken, if the data set has them.
const MIN_ATOMS: usize = 4000;

/// A frame with atoms of the sample.
pub struct SampledFrame {
    /// Its first line in the file.
    pub line: usize,
    /// All its atoms.
    pub structure: Structure,
    /// Those that are monitored, in order.
    pub atoms: Vec<usize>,
}

/// Species of the atoms of a frame, with their numbers.
type ElementCounts = Vec<(Species, usize)>;

/// The sample of a file, which is read frame by frame, twice. Each element has the same number of atoms, or all there
/// are, spread evenly over the file.
pub fn read(path: &Path) -> Result<Vec<SampledFrame>, String> {
    let frames = || XyzReader::open(path).map_err(|error| error.to_string());
    let mut counts = Vec::new();
    for frame in frames()? {
        counts.push(count(&frame.map_err(|error| error.to_string())?.structure));
    }
    if counts.iter().all(Vec::is_empty) {
        return Err(format!("{}: found no frames with atoms, expected at least one", path.display()));
    }
    let selected = select(&counts);
    let mut thinning = Thinning::new(&counts, &selected);
    let mut sample = Vec::new();
    for (frame, _) in frames()?.zip(&selected).filter(|(_, selected)| **selected) {
        let frame = frame.map_err(|error| error.to_string())?;
        let species = frame.structure.species.iter().enumerate();
        let atoms = species.filter(|(_, species)| thinning.keeps(**species)).map(|(atom, _)| atom);
        sample.push(SampledFrame { line: frame.line, atoms: atoms.collect(), structure: frame.structure });
    }
    Ok(sample)
}

fn count(structure: &Structure) -> ElementCounts {
    let mut counts: BTreeMap<Species, usize> = BTreeMap::new();
    structure.species.iter().for_each(|species| *counts.entry(*species).or_default() += 1);
    counts.into_iter().collect()
}

/// Number of atoms of each element in the sample, for this number of elements.
fn wanted(elements: usize) -> usize {
    ATOMS_PER_ELEMENT.max(MIN_ATOMS / elements.max(1))
}

/// Whether each frame has atoms of the sample. Frames with rare elements come first; those of an element are spread evenly
/// over the file.
fn select(frames: &[ElementCounts]) -> Vec<bool> {
    let mut with: BTreeMap<Species, (usize, Vec<usize>)> = BTreeMap::new();
    for (frame, counts) in frames.iter().enumerate() {
        for &(species, count) in counts {
            let (atoms, frames) = with.entry(species).or_default();
            *atoms += count;
            frames.push(frame);
        }
    }
    let wanted = wanted(with.len());
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

/// Takes atoms of an element at even intervals: frames with rare elements have too many of the frequent ones.
struct Thinning {
    wanted: usize,
    /// Atoms of each element in the selected frames: number, and how many were seen.
    atoms: BTreeMap<Species, (usize, usize)>,
}

impl Thinning {
    fn new(frames: &[ElementCounts], selected: &[bool]) -> Self {
        let mut atoms: BTreeMap<Species, (usize, usize)> = BTreeMap::new();
        for (frame, _) in frames.iter().zip(selected).filter(|(_, selected)| **selected) {
            frame.iter().for_each(|(species, count)| atoms.entry(*species).or_default().0 += count);
        }
        // Every element has a selected frame.
        Self { wanted: wanted(atoms.len()), atoms }
    }

    /// Whether the next atom, of this element, belongs to the sample.
    fn keeps(&mut self, species: Species) -> bool {
        let Some((all, seen)) = self.atoms.get_mut(&species) else { return false };
        let taken = |seen: usize| seen * self.wanted.min(*all) / *all;
        *seen += 1;
        taken(*seen) > taken(*seen - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn species(symbol: &str) -> Species {
        symbol.parse().unwrap()
    }

    /// Number of sampled atoms of each element in each frame.
    fn sampled(frames: &[ElementCounts]) -> Vec<ElementCounts> {
        let selected = select(frames);
        let mut thinning = Thinning::new(frames, &selected);
        let sampled = |(frame, selected): (&ElementCounts, bool)| {
            let count = |&(species, count): &(Species, usize)| {
                let atoms = if selected { count } else { 0 };
                (species, (0..atoms).filter(|_| thinning.keeps(species)).count())
            };
            frame.iter().map(count).collect()
        };
        frames.iter().zip(selected).map(sampled).collect()
    }

    fn atoms_of(frames: &[ElementCounts], symbol: &str) -> usize {
        frames.iter().flatten().filter(|(other, _)| *other == species(symbol)).map(|(_, count)| count).sum()
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
        let sampled = sampled(&frames);
        assert_eq!(["O", "H", "U"].map(|symbol| atoms_of(&sampled, symbol)), [1333, 1333, 6]);
        // Spread over the file.
        for symbol in ["O", "H"] {
            let half = atoms_of(&sampled[..10_000], symbol);
            assert!(half.abs_diff(1333 / 2) < 20, "{symbol}: {half}");
        }
    }

    #[test]
    fn a_small_data_set_is_taken_whole() {
        let frames = vec![vec![(species("Al"), 108)]; 30];
        assert_eq!(sampled(&frames), frames);
        let frames = vec![vec![(species("Al"), 108)]; 50];
        assert_eq!(select(&frames).iter().filter(|selected| **selected).count(), 38);
        assert_eq!(atoms_of(&sampled(&frames), "Al"), 4000);
    }
}
