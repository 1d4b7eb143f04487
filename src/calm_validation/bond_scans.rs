//! Bond scans: perfect crystals from compression to separated atoms.

use std::collections::BTreeMap;

use atoms::prototypes::{GroundState, Prototype};
use atoms::{Cell, Repetition, Species, Structure};
use serde::Serialize;

use super::detection::{COMPRESSION, Detection, LONGEST, detect};
use super::{Subject, ValidationGrader, ValidationProgress, ValidationSettings, minimum};
use crate::all_cores;

/// Shortest distance of a scan, Å; half the equilibrium distance if that leaves too little compression, but at least
/// [`DENSEST`].
const SHORTEST: f64 = 1.5;
/// Atoms that are closer have thousands of neighbours, Å.
const DENSEST: f64 = 1.0;
/// Where the equilibrium is searched, ln(d / expected d), and grid points of the search.
const SEARCHED: ([f64; 2], usize) = ([-0.5, 0.5], 41);
/// The same for a prototype in the place of the element's structure, whose distance is a guess, at least [`SHORTEST`].
const SEARCHED_WIDELY: ([f64; 2], usize) = ([-0.5, 1.1], 65);

/// A scan of one prototype.
#[derive(Clone, Debug, Serialize)]
pub struct BondScan {
    /// The element.
    pub element: String,
    /// The crystal.
    pub prototype: String,
    /// Whether this is the element's ground state, or the prototype in its place; the others show the grade of a
    /// crystal that the element does not form.
    pub is_ground_state: bool,
    /// Whether the element really forms this crystal; only these decide on detection.
    pub is_own: bool,
    /// Atoms of the supercell.
    pub atoms: usize,
    /// Distance of nearest neighbours with the lowest energy, Å.
    pub equilibrium: f64,
    /// Whether it is the model's; otherwise the model has no minimum near the published distance, which is given.
    pub is_relaxed: bool,
    /// Energy per atom at that distance, eV; `None` if it is not finite.
    pub energy: Option<f64>,
    /// The scan.
    pub points: Vec<ScanPoint>,
    /// What each score detects.
    pub detection: Vec<Detection>,
}

/// A structure of a scan.
#[derive(Clone, Debug, Serialize)]
pub struct ScanPoint {
    /// Distance of nearest neighbours, Å.
    pub distance: f64,
    /// Energy per atom, eV; `None` if it is not finite.
    pub energy: Option<f64>,
    /// The largest value of each score; `None` if the structure cannot be scored.
    pub scores: Vec<Option<f64>>,
}

/// The ground state of an element, and fcc or bcc as one that it does not form.
fn prototypes(species: Species) -> Vec<(Species, GroundState, bool)> {
    let ground = species.ground_state();
    let other = GroundState { prototype: other_prototype(species), is_own: false, ..ground };
    vec![(species, ground, true), (species, other, false)]
}

/// Bcc, or fcc for an element whose ground state is bcc.
pub fn other_prototype(species: Species) -> Prototype {
    if species.ground_state().prototype == Prototype::Bcc { Prototype::Fcc } else { Prototype::Bcc }
}

/// Number of scans.
pub fn count(settings: &ValidationSettings) -> usize {
    2 * settings.elements.len()
}

/// Scans all elements.
pub fn run(subject: &Subject, settings: &ValidationSettings, progress: &ValidationProgress) -> Vec<BondScan> {
    let scans: Vec<_> = settings.elements.iter().flat_map(|species| prototypes(*species)).collect();
    all_cores::map(
        scans.into_iter(),
        || ValidationGrader::new(subject),
        |grader, (species, expected, is_ground_state)| {
            let found = scan(grader, subject, settings, progress, (species, expected, is_ground_state));
            progress.advance();
            found
        },
    )
}

/// The equilibrium distance of each element's ground state, or of the crystal that it does not form, Å.
pub fn distances(scans: &[BondScan], of_ground_states: bool) -> BTreeMap<String, f64> {
    let scans = scans.iter().filter(|scan| scan.is_ground_state == of_ground_states);
    scans.map(|scan| (scan.element.clone(), scan.equilibrium)).collect()
}

/// Detection in the scans of all ground states, without prototypes in their place: yes only if it is yes in every scan that has the regime.
/// Of the largest values, the smallest; of the others, the largest.
pub fn combined_detection(scans: &[BondScan], score: usize) -> Detection {
    let all: Vec<_> = scans
        .iter()
        .filter(|scan| scan.is_ground_state && scan.is_own)
        .map(|scan| scan.detection[score])
        .collect();
    let every = |of: fn(&Detection) -> Option<bool>| all.iter().filter_map(of).reduce(|a, b| a && b);
    let extreme =
        |of: fn(&Detection) -> Option<f64>, pick: fn(f64, f64) -> f64| all.iter().filter_map(of).reduce(pick);
    Detection {
        compression: every(|found| found.compression),
        stretching: every(|found| found.stretching),
        interpolation: every(|found| found.interpolation),
        largest_in_compression: extreme(|found| found.largest_in_compression, f64::min),
        largest_in_stretching: extreme(|found| found.largest_in_stretching, f64::min),
        at_equilibrium: extreme(|found| found.at_equilibrium, f64::max),
        median_near_equilibrium: extreme(|found| found.median_near_equilibrium, f64::max),
    }
}

fn scan(
    grader: &mut ValidationGrader,
    subject: &Subject,
    settings: &ValidationSettings,
    progress: &ValidationProgress,
    (species, expected, is_ground_state): (Species, GroundState, bool),
) -> BondScan {
    let prototype = expected.prototype;
    let (range, grid) = if expected.is_own { SEARCHED } else { SEARCHED_WIDELY };
    let guess = if expected.is_own { expected.distance } else { expected.distance.max(SHORTEST) };
    let relaxed = minimum::nearest(guess, range, grid, |distance| {
        let is_stopped = progress.is_stopped();
        if is_stopped { None } else { grader.energy(&prototype.structure(species, distance)) }
    });
    let equilibrium = relaxed.unwrap_or(guess);
    let enough = 0.9 * COMPRESSION * equilibrium;
    let shortest = if enough < SHORTEST { DENSEST.max(0.5 * equilibrium) } else { SHORTEST };
    // At equilibrium, opposite faces are at least a cutoff apart.
    let cell = prototype.structure(species, equilibrium);
    let repetition = Repetition::for_size(&cell, 1, subject.model.cutoff());
    let steps = settings.scan_steps;
    let distance = |k: usize| shortest + (LONGEST - shortest) * k as f64 / (steps - 1) as f64;
    let cell = cell.repeated(repetition);
    let points: Vec<_> = (0..steps)
        .map(distance)
        .take_while(|_| !progress.is_stopped())
        .map(|distance| ScanPoint::new(grader, &scaled(&cell, distance / equilibrium), distance, subject))
        .collect();
    let at_equilibrium =
        ScanPoint::new(grader, &prototype.structure(species, equilibrium), equilibrium, subject);
    let rules = subject.scores().into_iter().map(|(_, rule)| rule).enumerate();
    let detection = rules.map(|(k, rule)| {
        let scores: Vec<_> = points.iter().map(|point| (point.distance, point.scores[k])).collect();
        detect(&scores, equilibrium, at_equilibrium.scores[k], rule)
    });
    BondScan {
        element: species.to_string(),
        prototype: prototype.to_string(),
        is_ground_state,
        is_own: expected.is_own,
        atoms: cell.len(),
        equilibrium,
        is_relaxed: relaxed.is_some(),
        energy: at_equilibrium.energy,
        detection: detection.collect(),
        points,
    }
}

impl ScanPoint {
    fn new(grader: &mut ValidationGrader, structure: &Structure, distance: f64, subject: &Subject) -> Self {
        match grader.grade(structure) {
            Ok(graded) => Self {
                distance,
                energy: Some(graded.energy / structure.len() as f64),
                scores: graded.scores.iter().map(|score| score.iter().copied().reduce(f64::max)).collect(),
            },
            Err(_) => Self { distance, energy: None, scores: vec![None; 1 + subject.others.len()] },
        }
    }
}

/// The structure with all lengths multiplied by `factor`.
pub fn scaled(structure: &Structure, factor: f64) -> Structure {
    let scaled = |vector: &[f64; 3]| vector.map(|x| factor * x);
    Structure {
        species: structure.species.clone(),
        positions: structure.positions.iter().map(scaled).collect(),
        cell: Cell(structure.cell.0.map(|vector| scaled(&vector))),
        periodic: structure.periodic,
    }
}
