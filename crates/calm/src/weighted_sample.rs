//! A sample of structures that stands for a data set of any size: about the same number of atoms of each element, and a weight
//! for each structure.

use std::collections::BTreeMap;

use crate::build::random_key;

/// Draws structures from a stream in one pass, without replacement.
///
/// Each structure has a random key, a function of the random seed and of its number in the stream. An element keeps the structures
/// with the smallest keys, as many as have fewer than N atoms of it without the largest of them: at least N atoms, or all there are,
/// and fewer than N plus those of its largest structure. The sample is what at least one element keeps. Elements rank structures by the same
/// keys, so that what one of them keeps serves the others, and large structures are not preferred.
///
/// With the smallest key τ that an element left out, as a share of all keys, a structure is in the sample if its key is below the
/// largest τ of its elements. No other key of a sampled structure below that limit changes the limit. The structure therefore counts
/// 1 / max τ times: weighted sums over the sample then have the sums over all data as their expectation, of any quantity and for all
/// elements at once (Horvitz & Thompson, J. Am. Stat. Assoc. 47, 663 (1952), with thresholds that depend on the data: Duffield, Lund
/// & Thorup, J. ACM 54, 32 (2007); Ting, arXiv:1708.04970).
///
/// Memory grows with the sample, not with the data.
#[derive(Debug)]
pub struct WeightedSampler {
    atoms_per_element: u64,
    seed: u64,
    /// Number of the next structure.
    next: u64,
    elements: BTreeMap<u8, ElementDraw>,
    kept: BTreeMap<u64, KeptStructure>,
}

/// The number of a structure in the stream, and the structures that left the sample because of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SampleChange {
    /// Its number, from 0.
    pub number: u64,
    /// Numbers of the structures that are no longer in the sample; its own if it does not belong to it.
    pub dropped: Vec<u64>,
}

/// A random number, and the number of the structure.
type SampleKey = (u64, u64);

/// A structure of the sample.
#[derive(Debug)]
struct KeptStructure {
    /// Each of its elements with its number of atoms.
    atoms: Vec<(u8, u64)>,
    /// Number of elements that keep it.
    holders: usize,
}

/// The structures that an element keeps.
#[derive(Debug, Default)]
struct ElementDraw {
    /// Atoms of the element in all data.
    in_data: u64,
    /// Atoms of the element in each structure.
    structures: BTreeMap<SampleKey, u64>,
    /// Sum of them.
    atoms: u64,
    /// How many structures have each number of atoms.
    sizes: BTreeMap<u64, usize>,
    /// The smallest key that was left out.
    left_out: Option<SampleKey>,
}

impl WeightedSampler {
    /// Aims at `atoms_per_element` atoms of each element, at least 1.
    pub fn new(atoms_per_element: u64, seed: u64) -> Self {
        Self {
            atoms_per_element: atoms_per_element.max(1),
            seed,
            next: 0,
            elements: BTreeMap::new(),
            kept: BTreeMap::new(),
        }
    }

    /// Takes the next structure. `atoms` has each of its elements, by any number of it, once, with its number of atoms. Elements
    /// without atoms are ignored.
    pub fn add(&mut self, mut atoms: Vec<(u8, u64)>) -> SampleChange {
        atoms.retain(|(_, count)| *count > 0);
        let number = self.next;
        self.next += 1;
        let key = (random_key(&[self.seed, number, SAMPLE]), number);
        let mut holders = 0;
        for &(element, count) in &atoms {
            let sample = self.elements.entry(element).or_default();
            sample.in_data += count;
            holders += usize::from(sample.insert(key, count));
        }
        if holders == 0 {
            return SampleChange { number, dropped: vec![number] };
        }
        let touched: Vec<u8> = atoms.iter().map(|(element, _)| *element).collect();
        self.kept.insert(number, KeptStructure { atoms, holders });
        let mut dropped = Vec::new();
        for element in touched {
            while let Some(number) = self.leave_out(element) {
                dropped.extend(self.release(number));
            }
        }
        SampleChange { number, dropped }
    }

    /// Number of structures so far.
    pub fn structures(&self) -> u64 {
        self.next
    }

    /// How many times a structure of the sample counts, 1 or more. `None` if it does not belong to the sample.
    pub fn weight(&self, number: u64) -> Option<f64> {
        let limits = self.kept.get(&number)?.atoms.iter().filter_map(|(element, _)| {
            let sample = self.elements.get(element)?;
            Some(sample.left_out.map_or(1.0, |(key, _)| key as f64 / KEYS))
        });
        Some(1.0 / limits.fold(0.0, f64::max))
    }

    /// Each element with the number of its atoms in all data.
    pub fn atoms_in_data(&self) -> impl Iterator<Item = (u8, u64)> {
        self.elements.iter().map(|(element, sample)| (*element, sample.in_data))
    }

    /// Numbers of the structures of the sample, ascending, with the atoms of their elements.
    pub fn sample(&self) -> impl Iterator<Item = (u64, &[(u8, u64)])> {
        self.kept.iter().map(|(number, kept)| (*number, &kept.atoms[..]))
    }

    /// The structure with the largest key that an element keeps leaves it, if there are more than it needs.
    fn leave_out(&mut self, element: u8) -> Option<u64> {
        self.elements.get_mut(&element)?.leave_out(self.atoms_per_element)
    }

    /// One element fewer keeps a structure. Returns its number if none is left.
    fn release(&mut self, number: u64) -> Option<u64> {
        let kept = self.kept.get_mut(&number)?;
        kept.holders -= 1;
        if kept.holders > 0 {
            return None;
        }
        self.kept.remove(&number);
        Some(number)
    }
}

impl ElementDraw {
    /// Keeps a structure with this number of atoms, unless its key is too large.
    fn insert(&mut self, key: SampleKey, atoms: u64) -> bool {
        if self.left_out.is_some_and(|left_out| key > left_out) {
            return false;
        }
        self.structures.insert(key, atoms);
        self.atoms += atoms;
        *self.sizes.entry(atoms).or_default() += 1;
        true
    }

    fn leave_out(&mut self, needed: u64) -> Option<u64> {
        let (largest, _) = self.sizes.last_key_value()?;
        if self.atoms - largest < needed {
            return None;
        }
        let (key, atoms) = self.structures.pop_last()?;
        self.atoms -= atoms;
        if let Some(count) = self.sizes.get_mut(&atoms) {
            *count -= 1;
            if *count == 0 {
                self.sizes.remove(&atoms);
            }
        }
        self.left_out = Some(key);
        Some(key.1)
    }
}

/// Number of possible random numbers of a key, 2⁶⁴.
const KEYS: f64 = 18_446_744_073_709_551_616.0;

/// Stands for the sample among the words that choose random numbers.
const SAMPLE: u64 = u64::MAX - 1;

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// Structures of 8 to 40 atoms of element 8, every tenth with some of element 1, every hundredth with some of element 92.
    fn data() -> Vec<Vec<(u8, u64)>> {
        let structure = |number: u64| {
            let mut atoms = vec![(8, 8 + number * 7 % 33)];
            atoms.extend((number % 10 == 3).then_some((1, 4 + number % 5)));
            atoms.extend((number % 100 == 13).then_some((92, 2)));
            atoms
        };
        (0..1000).map(structure).collect()
    }

    fn drawn(atoms_per_element: u64, seed: u64, data: &[Vec<(u8, u64)>]) -> WeightedSampler {
        let mut sampler = WeightedSampler::new(atoms_per_element, seed);
        let mut held = BTreeSet::new();
        for atoms in data {
            let change = sampler.add(atoms.clone());
            held.insert(change.number);
            change.dropped.iter().for_each(|number| assert!(held.remove(number)));
        }
        assert!(held.into_iter().eq(sampler.sample().map(|(number, _)| number)));
        sampler
    }

    /// Atoms of an element in the sample, each counted as often as its structure's weight says.
    fn weighted(sampler: &WeightedSampler, element: u8) -> f64 {
        let of = |(number, atoms): (u64, &[(u8, u64)])| {
            let found = atoms.iter().find(|(other, _)| *other == element);
            found.map_or(0.0, |(_, count)| *count as f64 * sampler.weight(number).unwrap())
        };
        sampler.sample().map(of).sum()
    }

    #[test]
    fn a_stream_gives_the_smallest_keys_of_each_element() {
        let data = data();
        let sampler = drawn(300, 5, &data);
        let mut expected = BTreeSet::new();
        for element in [1, 8, 92] {
            let mut ranked: Vec<_> = (0..)
                .zip(&data)
                .filter_map(|(number, atoms)| {
                    let count = atoms.iter().find(|(other, _)| *other == element)?.1;
                    Some((random_key(&[5, number, SAMPLE]), number, count))
                })
                .collect();
            ranked.sort_unstable();
            let (mut sum, mut largest) = (0, 0);
            for (_, number, count) in ranked {
                (sum, largest) = (sum + count, count.max(largest));
                if sum - largest >= 300 {
                    break;
                }
                expected.insert(number);
            }
        }
        assert!(expected.into_iter().eq(sampler.sample().map(|(number, _)| number)));
    }

    #[test]
    fn each_element_has_the_atoms_asked_for_or_all() {
        let data = data();
        for seed in 0..20 {
            let sampler = drawn(200, seed, &data);
            let in_sample = |element: u8| -> u64 {
                let atoms = sampler.sample().flat_map(|(_, atoms)| atoms);
                atoms.filter(|(other, _)| *other == element).map(|(_, count)| count).sum()
            };
            // 203 of 7 a structure, and up to 70 of the structures that uranium keeps; those that oxygen keeps are among them.
            assert!((200..=273).contains(&in_sample(1)), "{}", in_sample(1));
            assert_eq!(in_sample(92), 20);
            // Structures that hydrogen and uranium keep come in addition.
            let others = 40 * sampler.sample().filter(|(_, atoms)| atoms.len() > 1).count() as u64;
            assert!((200..240 + others).contains(&in_sample(8)), "{}", in_sample(8));
            for (number, atoms) in sampler.sample() {
                let weight = sampler.weight(number).unwrap();
                // Structures with all atoms of an element that there are stand for themselves.
                assert_eq!(atoms.iter().any(|(element, _)| *element == 92), weight == 1.0);
            }
        }
    }

    /// The mean and its standard error.
    fn mean_and_error(values: &[f64]) -> (f64, f64) {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (count - 1.0);
        (mean, (variance / count).sqrt())
    }

    /// The mean over random seeds is the number of atoms in the data, within five times its standard error.
    #[test]
    fn weighted_sums_are_those_of_all_data() {
        let data = data();
        let samplers: Vec<_> = (0..400).map(|seed| drawn(300, seed, &data)).collect();
        for (element, in_data) in samplers[0].atoms_in_data() {
            let found: Vec<f64> = samplers.iter().map(|sampler| weighted(sampler, element)).collect();
            let ((mean, error), in_data) = (mean_and_error(&found), in_data as f64);
            assert!((mean - in_data).abs() <= 5.0 * error, "{element}: {mean} ± {error}, {in_data}");
            // About twelve structures without hydrogen: an error of 0.3 of the atoms, by the square root of 400.
            assert!(error < 0.03 * in_data, "{element}: {error}, {in_data}");
        }
    }

    type Kind = fn(u64) -> bool;

    /// Structures of one kind count as often as there are of them, whatever their place and size.
    #[test]
    fn weights_depend_on_neither_place_nor_size() {
        let data: Vec<_> = (0..100).map(|number| vec![(8, if number % 2 == 0 { 10 } else { 30 })]).collect();
        let samplers: Vec<_> = (0..500).map(|seed| drawn(400, seed, &data)).collect();
        let of = |is_counted: fn(u64) -> bool| {
            let sum = |sampler: &WeightedSampler| -> f64 {
                let counted = sampler.sample().filter(|(number, _)| is_counted(*number));
                counted.map(|(number, _)| sampler.weight(number).unwrap()).sum()
            };
            mean_and_error(&samplers.iter().map(sum).collect::<Vec<_>>())
        };
        let kinds: [(&str, Kind); 3] = [
            ("first half", |number| number < 50),
            ("large", |number| number % 2 == 1),
            ("small", |number| number % 2 == 0),
        ];
        for (what, is_counted) in kinds {
            let (mean, error) = of(is_counted);
            assert!((mean - 50.0).abs() < 5.0 * error && error < 2.0, "{what}: {mean} ± {error}");
        }
    }

    #[test]
    fn small_data_are_taken_whole_and_structures_without_atoms_never() {
        let data = [vec![(13, 108)], vec![], vec![(13, 4), (28, 4)]];
        let sampler = drawn(1000, 1, &data);
        let sample: Vec<_> = sampler.sample().map(|(number, _)| number).collect();
        assert_eq!((sample, sampler.structures()), (vec![0, 2], 3));
        assert_eq!([0, 1, 2].map(|number| sampler.weight(number)), [Some(1.0), None, Some(1.0)]);
        assert!(sampler.atoms_in_data().eq([(13, 112), (28, 4)]));
        // An element without atoms has no say in the weights.
        let [mut plain, mut padded] = [1, 1].map(|seed| WeightedSampler::new(100, seed));
        for _ in 0..100 {
            plain.add(vec![(13, 10)]);
            padded.add(vec![(13, 10), (28, 0)]);
        }
        let numbers = || plain.sample().map(|(number, _)| number);
        assert!(numbers().all(|number| plain.weight(number) > Some(1.0)));
        assert!(numbers().all(|number| plain.weight(number) == padded.weight(number)));
        assert!(padded.atoms_in_data().eq([(13, 1000)]));
        // A structure that is larger than what is asked for is not left out.
        assert_eq!(drawn(1, 1, &data[..1]).sample().count(), 1);
    }

    #[test]
    fn another_seed_draws_other_structures() {
        let data = data();
        let numbers =
            |seed| -> Vec<u64> { drawn(100, seed, &data).sample().map(|(number, _)| number).collect() };
        assert_eq!(numbers(1), numbers(1));
        assert!(numbers(1) != numbers(2));
    }
}
