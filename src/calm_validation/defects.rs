//! Vacancies, surfaces and grain boundaries: scores by the distance to the defect.

use std::collections::BTreeMap;

use atoms::cell::{norm, sub};
use atoms::prototypes::{Facet, Prototype, grain_boundary, slab, vacancy};
use atoms::{Species, Structure, Vec3};
use serde::Serialize;

use super::grader::Graded;
use super::{Subject, ValidationGrader, ValidationProgress, ValidationSettings};
use crate::all_cores;

/// Atoms whose distances differ by less are one shell, Å.
const SHELL: f64 = 0.05;

/// A defect with the scores of its atoms.
#[derive(Clone, Debug, Serialize)]
pub struct Defect {
    /// The element.
    pub element: String,
    /// The crystal.
    pub prototype: String,
    /// What it is.
    pub kind: DefectKind,
    /// Its name: the facet of a surface.
    pub name: &'static str,
    /// The relaxation of its positions; `None` if positions are ideal, because nothing else was asked for or atoms collapse.
    pub relaxation: Option<Relaxation>,
    /// Scores of the perfect crystal, as [`Shell::scores`].
    pub crystal: Vec<f64>,
    /// The atoms, by distance to the defect in the ideal structure.
    pub shells: Vec<Shell>,
    /// Why it has no scores.
    pub error: Option<String>,
    /// Where the missing atom of a vacancy was, Å.
    pub centre: Option<Vec3>,
    /// The graded structure, with γ and γ_nbr of its atoms.
    #[serde(skip)]
    pub graded: Option<(Structure, Vec<f64>, Vec<f64>)>,
}

/// Kind of a defect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DefectKind {
    Vacancy,
    Surface,
    GrainBoundary,
}

/// What a relaxation did.
#[derive(Clone, Debug, Serialize)]
pub struct Relaxation {
    /// Steps made.
    pub steps: usize,
    /// Whether the largest force is below the limit.
    pub is_converged: bool,
    /// The longest way of an atom, Å.
    pub largest_displacement: f64,
}

/// Atoms at one distance to the defect.
#[derive(Clone, Debug, Serialize)]
pub struct Shell {
    /// Å: to the centre of the vacancy, below the outermost layer, or to the plane of the boundary.
    pub distance: f64,
    /// Number of atoms.
    pub atoms: usize,
    /// Mean of each score.
    pub scores: Vec<f64>,
    /// Largest of each score.
    pub largest: Vec<f64>,
    /// Mean of each neighbourhood-averaged score.
    pub averages: Vec<f64>,
}

/// A defect to be built.
type Task = (Species, Prototype, f64, DefectKind, Option<Facet>);

/// The defects of the crystals that elements really form.
fn tasks(settings: &ValidationSettings, distance: impl Fn(Species) -> f64) -> Vec<Task> {
    let of = |species: &Species| {
        let (species, prototype) = (*species, species.ground_state().prototype);
        let d = distance(species);
        let facets =
            Facet::for_prototype(prototype).iter().map(move |facet| (DefectKind::Surface, Some(*facet)));
        let has_boundary = matches!(prototype, Prototype::Fcc | Prototype::Bcc);
        let boundary = has_boundary.then_some((DefectKind::GrainBoundary, None));
        let all = [(DefectKind::Vacancy, None)].into_iter().chain(facets).chain(boundary);
        all.map(move |(kind, facet)| (species, prototype, d, kind, facet))
    };
    settings.elements.iter().filter(|species| species.ground_state().is_own).flat_map(of).collect()
}

/// Number of defects.
pub fn count(settings: &ValidationSettings) -> usize {
    tasks(settings, |species| species.ground_state().distance).len()
}

/// Relaxes and grades the defects of all elements, with these equilibrium distances, Å.
pub fn run(
    subject: &Subject,
    settings: &ValidationSettings,
    distances: &BTreeMap<String, f64>,
    progress: &ValidationProgress,
) -> Vec<Defect> {
    let tasks = tasks(settings, |species| distances[species.symbol()]);
    all_cores::map(
        tasks.into_iter(),
        || ValidationGrader::new(subject),
        |grader, task| {
            let defect = Defect::new(grader, settings, progress, task);
            progress.advance();
            defect
        },
    )
}

impl Defect {
    fn new(
        grader: &mut ValidationGrader,
        settings: &ValidationSettings,
        progress: &ValidationProgress,
        (species, prototype, distance, kind, facet): Task,
    ) -> Self {
        let (ideal, distances, centre) = ideal(species, prototype, distance, kind, facet);
        let (mut structure, mut relaxation) = relaxed(grader, settings, progress, &ideal);
        let mut graded = grader.grade(&structure);
        if graded.is_err() && relaxation.is_some() {
            // The model lets atoms collapse.
            (structure, relaxation) = (ideal, None);
            graded = grader.grade(&structure);
        }
        let crystal = grader.grade(&prototype.structure(species, distance));
        let mut defect = Self {
            element: species.to_string(),
            prototype: prototype.to_string(),
            kind,
            name: facet.map_or(kind.name(), Facet::name),
            relaxation,
            crystal: crystal.map_or(Vec::new(), |graded| graded.scores.iter().map(|of| of[0]).collect()),
            shells: Vec::new(),
            error: None,
            centre,
            graded: None,
        };
        match graded {
            Ok(graded) => {
                defect.shells = shells(&distances, &graded);
                let [gamma, averages] = [graded.scores, graded.averages].map(|mut of| of.swap_remove(0));
                defect.graded = Some((structure, gamma, averages));
            }
            Err(error) => defect.error = Some(error),
        }
        defect
    }
}

impl DefectKind {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vacancy => "vacancy",
            Self::Surface => "surface",
            Self::GrainBoundary => "Σ5 (310)",
        }
    }
}

/// The unrelaxed structure, the distance of its atoms to the defect and the centre of a vacancy, Å.
fn ideal(
    species: Species,
    prototype: Prototype,
    distance: f64,
    kind: DefectKind,
    facet: Option<Facet>,
) -> (Structure, Vec<f64>, Option<Vec3>) {
    if let Some(facet) = facet {
        let slab = slab(prototype, species, distance, facet);
        let depths = slab.depths();
        return (slab.structure, depths, None);
    }
    let boundary = || grain_boundary(prototype, species, distance);
    match Some(kind).filter(|kind| *kind == DefectKind::GrainBoundary).and_then(|_| boundary()) {
        Some(found) => {
            let distances = found.distances();
            (found.structure, distances, None)
        }
        None => {
            let found = vacancy(prototype, species, distance);
            let distances = found.distances();
            (found.structure, distances, Some(found.centre))
        }
    }
}

/// The structure with relaxed positions, if that was asked for and is possible.
fn relaxed(
    grader: &mut ValidationGrader,
    settings: &ValidationSettings,
    progress: &ValidationProgress,
    ideal: &Structure,
) -> (Structure, Option<Relaxation>) {
    let Some(fire) = settings.relaxation else { return (ideal.clone(), None) };
    let stop = || progress.is_stopped();
    match fire.relax(ideal.clone(), &mut grader.features.grace, &stop) {
        Ok(found) => {
            let pairs = found.structure.positions.iter().zip(&ideal.positions);
            let largest_displacement = pairs.map(|(a, b)| norm(sub(*a, *b))).fold(0.0, f64::max);
            let (steps, is_converged) = (found.steps, found.is_converged);
            (found.structure, Some(Relaxation { steps, is_converged, largest_displacement }))
        }
        Err(_) => (ideal.clone(), None),
    }
}

/// Groups atoms by distance.
fn shells(distances: &[f64], graded: &Graded) -> Vec<Shell> {
    let mut order: Vec<_> = (0..distances.len()).collect();
    order.sort_by(|a, b| distances[*a].total_cmp(&distances[*b]).then(a.cmp(b)));
    let groups = order.chunk_by(|a, b| distances[*b] - distances[*a] < SHELL);
    let shell = |atoms: &[usize]| {
        let mean = |of: &Vec<f64>| atoms.iter().map(|atom| of[*atom]).sum::<f64>() / atoms.len() as f64;
        let largest = |of: &Vec<f64>| atoms.iter().map(|atom| of[*atom]).fold(f64::NEG_INFINITY, f64::max);
        Shell {
            distance: atoms.iter().map(|atom| distances[*atom]).sum::<f64>() / atoms.len() as f64,
            atoms: atoms.len(),
            scores: graded.scores.iter().map(mean).collect(),
            largest: graded.scores.iter().map(largest).collect(),
            averages: graded.averages.iter().map(mean).collect(),
        }
    };
    groups.map(shell).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn atoms_at_one_distance_are_a_shell() {
        let scores = vec![vec![1.0, 5.0, 2.0, 3.0, 4.0]];
        let averages = vec![vec![0.5; 5]];
        let graded = Graded { energy: 0.0, scores, averages };
        let found = shells(&[2.0, 0.0, 2.01, 1.99, 3.0], &graded);
        let summary: Vec<_> = found.iter().map(|of| (of.atoms, of.scores[0], of.largest[0])).collect();
        assert_eq!(summary, [(1, 5.0, 5.0), (3, 2.0, 3.0), (1, 4.0, 4.0)]);
        assert!((found[1].distance - 2.0).abs() < 1e-12 && found[1].averages == [0.5]);
    }

    #[test]
    fn every_crystal_has_its_defects() {
        let elements = ["Al", "W", "Si", "H", "Ti"].map(|symbol| symbol.parse().unwrap()).to_vec();
        let settings = ValidationSettings {
            elements,
            pairs: Vec::new(),
            scan_steps: 2,
            relaxation: None,
            solution_structures: 1,
            seed: 0,
        };
        assert_eq!(count(&settings), 5 + 5 + 4 + 2);
        for (species, prototype, distance, kind, facet) in tasks(&settings, |_| 2.5) {
            let (structure, distances, _) = ideal(species, prototype, distance, kind, facet);
            assert_eq!(structure.len(), distances.len());
            let nearest = distances.iter().copied().fold(f64::INFINITY, f64::min);
            let expected = if kind == DefectKind::Vacancy { 2.5 } else { 0.0 };
            assert!((nearest - expected).abs() < 1e-9, "{species} {kind:?} {facet:?}: {nearest}");
        }
    }
}
