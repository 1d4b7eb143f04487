//! Composition scans of random solid solutions.

use std::collections::BTreeMap;

use atoms::prototypes::Prototype;
use atoms::{NeighbourList, Repetition, Species, Structure};
use serde::Serialize;

use super::bond_scans::scaled;
use super::random::RandomSequence;
use super::{Subject, ValidationGrader, ValidationProgress, ValidationSettings, minimum};
use crate::all_cores;
use crate::exit_status::CommandError;

/// Compositions: 0, 10 %, …, 100 % of the second element.
const COMPOSITIONS: usize = 11;
/// Standard deviation of each Cartesian displacement, Å.
const DISPLACEMENT: f64 = 0.1;
/// Where the volume is searched, ln of lengths relative to the mean of both elements, and grid points.
const SEARCHED: ([f64; 2], usize) = ([-0.12, 0.12], 13);

/// Solid solutions of two elements.
#[derive(Clone, Debug, Serialize)]
pub struct Solution {
    /// The elements.
    pub elements: [String; 2],
    /// The lattice.
    pub prototype: String,
    /// Structures by composition.
    pub compositions: Vec<Composition>,
    /// Atoms by the composition of their first shell.
    pub first_shells: Vec<FirstShell>,
}

/// The structures of one composition.
#[derive(Clone, Debug, Serialize)]
pub struct Composition {
    /// Share of the second element.
    pub fraction: f64,
    /// Distance of nearest neighbours before atoms are displaced, Å.
    pub distance: f64,
    /// Whether it is the model's; otherwise the model has no minimum near the mean of both elements, which is given.
    pub is_relaxed: bool,
    /// Structures with scores.
    pub structures: usize,
    /// Mean of each score over all atoms.
    pub scores: Vec<f64>,
    /// Mean of each neighbourhood-averaged score.
    pub averages: Vec<f64>,
    /// Share of the atoms with γ > 1.
    pub above_1: f64,
    /// Share of the atoms with γ_nbr > 1.
    pub averages_above_1: f64,
}

/// Atoms with the same first shell, over all compositions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FirstShell {
    /// The element of the atoms.
    pub element: String,
    /// Share of the second element among their nearest neighbours.
    pub fraction: f64,
    /// Number of atoms.
    pub atoms: usize,
    /// Their mean γ.
    pub gamma: f64,
}

/// An atom of a solution.
struct SolutionAtom {
    is_second: bool,
    /// Nearest neighbours of the second element.
    neighbours: usize,
    gamma: f64,
}

/// Number of compositions.
pub fn count(settings: &ValidationSettings) -> usize {
    settings.pairs.len() * COMPOSITIONS
}

/// The lattice: that of the first element if it is fcc or bcc, otherwise fcc.
pub fn lattice([first, _]: [Species; 2]) -> (Prototype, Repetition, usize) {
    match first.ground_state().prototype {
        Prototype::Bcc => (Prototype::Bcc, Repetition([4, 4, 4]), 8),
        _ => (Prototype::Fcc, Repetition([4, 4, 2]), 12),
    }
}

/// Scans all pairs of elements, with the equilibrium distances of the elements, Å.
pub fn run(
    subject: &Subject,
    settings: &ValidationSettings,
    distances: &BTreeMap<String, f64>,
    progress: &ValidationProgress,
) -> Result<Vec<Solution>, CommandError> {
    let tasks = (0..settings.pairs.len()).flat_map(|pair| (0..COMPOSITIONS).map(move |step| (pair, step)));
    let tasks: Vec<_> = tasks.collect();
    let graded = all_cores::map(
        tasks.into_iter(),
        || ValidationGrader::new(subject),
        |grader, (pair, step)| {
            let found = composition(grader, settings, distances, progress, (pair, step));
            progress.advance();
            found
        },
    );
    let mut graded = graded.into_iter();
    let solution = |pair: &[Species; 2]| -> Result<Solution, CommandError> {
        let of_pair: Vec<_> = graded.by_ref().take(COMPOSITIONS).collect::<Result<_, _>>()?;
        let (compositions, atoms): (Vec<_>, Vec<_>) = of_pair.into_iter().unzip();
        let (prototype, _, shell) = lattice(*pair);
        let atoms: Vec<_> = atoms.into_iter().flatten().collect();
        let elements = pair.map(|species| species.to_string());
        let first_shells = first_shells(&elements, &atoms, shell);
        Ok(Solution { prototype: prototype.to_string(), compositions, first_shells, elements })
    };
    settings.pairs.iter().map(solution).collect()
}

/// One composition, with its atoms.
fn composition(
    grader: &mut ValidationGrader,
    settings: &ValidationSettings,
    distances: &BTreeMap<String, f64>,
    progress: &ValidationProgress,
    (pair, step): (usize, usize),
) -> Result<(Composition, Vec<SolutionAtom>), CommandError> {
    let elements = settings.pairs[pair];
    let fraction = step as f64 / (COMPOSITIONS - 1) as f64;
    let [first, second] = elements.map(|species| distances[species.symbol()]);
    let (prototype, repetition, _) = lattice(elements);
    let expected = (1.0 - fraction) * first + fraction * second;
    let crystal = prototype.structure(elements[0], expected).repeated(repetition);
    let random = |structure: usize| {
        let sequence = (pair * COMPOSITIONS + step) * settings.solution_structures + structure;
        RandomSequence::new(settings.seed, sequence as u64)
    };
    let occupied = occupied(&crystal, elements[1], fraction, &mut random(0));
    let relaxed = minimum::nearest(1.0, SEARCHED.0, SEARCHED.1, |factor| {
        let is_stopped = progress.is_stopped();
        if is_stopped { None } else { grader.energy(&scaled(&occupied, factor)) }
    });
    let factor = relaxed.unwrap_or(1.0);
    let crystal = scaled(&crystal, factor);
    let neighbours = nearest_neighbours(&crystal, factor * expected)?;
    let (mut sums, mut atoms) = (CompositionSums::default(), Vec::new());
    for number in 0..settings.solution_structures {
        if progress.is_stopped() {
            break;
        }
        let mut random = random(number);
        let mut structure = self::occupied(&crystal, elements[1], fraction, &mut random);
        for x in structure.positions.iter_mut().flatten() {
            *x += DISPLACEMENT * random.normal();
        }
        let Ok(graded) = grader.grade(&structure) else { continue };
        sums.add(&graded.scores, &graded.averages);
        let is_second = |atom: &usize| structure.species[*atom] == elements[1];
        atoms.extend(graded.scores[0].iter().enumerate().map(|(atom, gamma)| SolutionAtom {
            is_second: is_second(&atom),
            neighbours: neighbours[atom].iter().filter(|atom| is_second(atom)).count(),
            gamma: *gamma,
        }));
    }
    let distance = factor * expected;
    Ok((sums.composition(fraction, distance, relaxed.is_some()), atoms))
}

/// The crystal with a random part of its sites occupied by another element.
fn occupied(crystal: &Structure, other: Species, fraction: f64, random: &mut RandomSequence) -> Structure {
    let mut structure = crystal.clone();
    let mut sites: Vec<_> = (0..crystal.len()).collect();
    // The first sites of a shuffled list (Fisher & Yates).
    for k in 0..(fraction * crystal.len() as f64).round() as usize {
        sites.swap(k, k + random.below(crystal.len() - k));
        structure.species[sites[k]] = other;
    }
    structure
}

/// Indices of the nearest neighbours of each site.
fn nearest_neighbours(crystal: &Structure, distance: f64) -> Result<Vec<Vec<usize>>, CommandError> {
    let mut list = NeighbourList::new(1.05 * distance, 0.0);
    list.update(crystal).map_err(CommandError::failed)?;
    let of = |site| list.neighbours_of(site).iter().map(|neighbour| neighbour.atom as usize).collect();
    Ok((0..crystal.len()).map(of).collect())
}

/// Groups atoms by element and first shell, which has `shell` neighbours.
fn first_shells(elements: &[String; 2], atoms: &[SolutionAtom], shell: usize) -> Vec<FirstShell> {
    let mut groups: BTreeMap<(bool, usize), (usize, f64)> = BTreeMap::new();
    for atom in atoms {
        let (number, sum) = groups.entry((atom.is_second, atom.neighbours)).or_default();
        (*number, *sum) = (*number + 1, *sum + atom.gamma);
    }
    let group = |((is_second, neighbours), (atoms, sum))| FirstShell {
        element: elements[usize::from(is_second)].clone(),
        fraction: neighbours as f64 / shell as f64,
        atoms,
        gamma: sum / atoms as f64,
    };
    groups.into_iter().map(group).collect()
}

/// Sums over the atoms of a composition.
#[derive(Default)]
struct CompositionSums {
    structures: usize,
    atoms: usize,
    scores: Vec<f64>,
    averages: Vec<f64>,
    above: [usize; 2],
}

impl CompositionSums {
    fn add(&mut self, scores: &[Vec<f64>], averages: &[Vec<f64>]) {
        self.structures += 1;
        self.atoms += scores[0].len();
        for (sums, of) in [(&mut self.scores, scores), (&mut self.averages, averages)] {
            sums.resize(of.len(), 0.0);
            sums.iter_mut().zip(of).for_each(|(sum, of)| *sum += of.iter().sum::<f64>());
        }
        let above = |of: &[f64]| of.iter().filter(|score| **score > 1.0).count();
        self.above[0] += above(&scores[0]);
        self.above[1] += above(&averages[0]);
    }

    fn composition(self, fraction: f64, distance: f64, is_relaxed: bool) -> Composition {
        let atoms = self.atoms.max(1) as f64;
        let means = |sums: Vec<f64>| sums.into_iter().map(|sum| sum / atoms).collect();
        Composition {
            fraction,
            distance,
            is_relaxed,
            structures: self.structures,
            scores: means(self.scores),
            averages: means(self.averages),
            above_1: self.above[0] as f64 / atoms,
            averages_above_1: self.above[1] as f64 / atoms,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn elements() -> [Species; 2] {
        ["Mo", "W"].map(|symbol| symbol.parse().unwrap())
    }

    #[test]
    fn solutions_have_128_atoms_of_the_given_composition() {
        for (pair, shell) in [(elements(), 8), (["Ni", "Al"].map(|symbol| symbol.parse().unwrap()), 12)] {
            let (prototype, repetition, expected) = lattice(pair);
            let crystal = prototype.structure(pair[0], 2.7).repeated(repetition);
            assert_eq!((crystal.len(), expected), (128, shell));
            assert!(nearest_neighbours(&crystal, 2.7).unwrap().iter().all(|of| of.len() == shell));
            for (step, number) in [(0, 0), (1, 13), (5, 64), (10, 128)] {
                let mixed =
                    occupied(&crystal, pair[1], f64::from(step) / 10.0, &mut RandomSequence::new(3, 4));
                assert_eq!(mixed.species.iter().filter(|species| **species == pair[1]).count(), number);
            }
        }
    }

    #[test]
    fn sites_are_occupied_at_random() {
        let crystal = Prototype::Bcc.structure(elements()[0], 2.7).repeated(Repetition([4; 3]));
        let mut occupations = vec![0; crystal.len()];
        for number in 0..400 {
            let mixed = occupied(&crystal, elements()[1], 0.25, &mut RandomSequence::new(1, number));
            let second = mixed.species.iter().map(|species| usize::from(*species == elements()[1]));
            occupations.iter_mut().zip(second).for_each(|(sum, second)| *sum += second);
        }
        // Binomial, 100 ± 8.7 of 400: five standard deviations.
        assert!(occupations.iter().all(|number| (57..143).contains(number)), "{occupations:?}");
        let same =
            |number| occupied(&crystal, elements()[1], 0.25, &mut RandomSequence::new(1, number)).species;
        assert!(same(7) == same(7) && same(7) != same(8));
    }

    #[test]
    fn atoms_are_grouped_by_their_first_shell() {
        let atom = |is_second, neighbours, gamma| SolutionAtom { is_second, neighbours, gamma };
        let atoms = [atom(true, 2, 1.0), atom(false, 2, 9.0), atom(true, 2, 3.0), atom(true, 8, 5.0)];
        let found = first_shells(&elements().map(|species| species.to_string()), &atoms, 8);
        let of = |element: &str, fraction, atoms, gamma| FirstShell {
            element: element.into(),
            fraction,
            atoms,
            gamma,
        };
        assert_eq!(found, [of("Mo", 0.25, 1, 9.0), of("W", 0.25, 2, 2.0), of("W", 1.0, 1, 5.0)]);
    }
}
