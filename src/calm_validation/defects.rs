//! Vacancies, surfaces and grain boundaries: scores by the distance to the defect.

use std::collections::BTreeMap;

use atoms::cell::{norm, sub};
use atoms::prototypes::{Facet, Prototype, grain_boundary, slab, vacancy};
use atoms::{Species, Structure, Vec3};
use md::Fire;
use serde::Serialize;

use super::bond_scans::other_prototype;
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
    /// Whether this is the element's ground state. Others show the grade at defects of a crystal that the element does not form.
    pub is_ground_state: bool,
    /// What it is.
    pub kind: DefectKind,
    /// Its name: the facet of a surface.
    pub name: &'static str,
    /// The relaxation of its positions; `None` if positions are ideal, because nothing else was asked for, atoms collapse or the
    /// element does not form the crystal.
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
#[derive(Clone, Copy, Debug)]
struct DefectTask {
    species: Species,
    prototype: Prototype,
    is_ground_state: bool,
    /// Å.
    distance: f64,
    kind: DefectKind,
    facet: Option<Facet>,
}

/// The defects of the crystals that elements really form, and after those of each element a vacancy and the (111) surface of a crystal
/// that it does not form (paper, 'Controlled structural and chemical extrapolation'). `distance` has the equilibrium distance of an
/// element, by whether the crystal is its ground state.
fn tasks(settings: &ValidationSettings, distance: impl Fn(Species, bool) -> f64) -> Vec<DefectTask> {
    let of = |species: Species| {
        let ground = species.ground_state().prototype;
        let facets = Facet::for_prototype(ground).iter().map(|facet| (DefectKind::Surface, Some(*facet)));
        let has_boundary = matches!(ground, Prototype::Fcc | Prototype::Bcc);
        let boundary = has_boundary.then_some((DefectKind::GrainBoundary, None));
        let own = [(DefectKind::Vacancy, None)].into_iter().chain(facets).chain(boundary);
        let own = own.map(|defect| (ground, true, defect));
        let others = [(DefectKind::Vacancy, None), (DefectKind::Surface, Some(Facet::F111))];
        let others = others.map(|defect| (other_prototype(species), false, defect));
        let task = |(prototype, is_ground_state, (kind, facet))| DefectTask {
            species,
            prototype,
            is_ground_state,
            distance: distance(species, is_ground_state),
            kind,
            facet,
        };
        own.chain(others).map(task).collect::<Vec<_>>()
    };
    settings.elements.iter().copied().filter(|species| species.ground_state().is_own).flat_map(of).collect()
}

/// Number of defects.
pub fn count(settings: &ValidationSettings) -> usize {
    tasks(settings, |species, _| species.ground_state().distance).len()
}

/// Relaxes and grades the defects of all elements, with the equilibrium distances of their ground states and of the crystals that they
/// do not form, Å.
pub fn run(
    subject: &Subject,
    settings: &ValidationSettings,
    [of_ground_states, of_others]: [&BTreeMap<String, f64>; 2],
    progress: &ValidationProgress,
) -> Vec<Defect> {
    let tasks = tasks(settings, |species, is_ground_state| {
        let distances = if is_ground_state { of_ground_states } else { of_others };
        distances[species.symbol()]
    });
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
        task: DefectTask,
    ) -> Self {
        let DefectTask { species, prototype, is_ground_state, distance, kind, facet } = task;
        let (ideal, distances, centre) = ideal(&task);
        let (mut structure, mut relaxation) = relaxed(grader, task.relaxation(settings), progress, &ideal);
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
            is_ground_state,
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

impl DefectTask {
    /// How positions are relaxed. A crystal that the element does not form would turn into another one, and keeps ideal positions.
    fn relaxation(&self, settings: &ValidationSettings) -> Option<Fire> {
        settings.relaxation.filter(|_| self.is_ground_state)
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
fn ideal(task: &DefectTask) -> (Structure, Vec<f64>, Option<Vec3>) {
    let DefectTask { species, prototype, distance, kind, facet, .. } = *task;
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

/// The structure with relaxed positions, if `fire` says how and it is possible.
fn relaxed(
    grader: &mut ValidationGrader,
    fire: Option<Fire>,
    progress: &ValidationProgress,
    ideal: &Structure,
) -> (Structure, Option<Relaxation>) {
    let Some(fire) = fire else { return (ideal.clone(), None) };
    let stop = || progress.is_stopped();
    match fire.relax(ideal.clone(), &mut *grader.features.potential, &stop) {
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
            relaxation: Some(Fire::default()),
            solution_structures: 1,
            collision_evaluations: 0,
            seed: 0,
        };
        // Two more of each element, of another crystal.
        assert_eq!(count(&settings), 5 + 5 + 4 + 2 + 4 * 2);
        let tasks = tasks(&settings, |_, is_ground_state| if is_ground_state { 2.5 } else { 2.7 });
        for task in &tasks {
            let (structure, distances, _) = ideal(task);
            assert_eq!(structure.len(), distances.len());
            let nearest = distances.iter().copied().fold(f64::INFINITY, f64::min);
            let expected = if task.kind == DefectKind::Vacancy { task.distance } else { 0.0 };
            assert!((nearest - expected).abs() < 1e-9, "{task:?}: {nearest}");
            assert_eq!(task.relaxation(&settings).is_some(), task.is_ground_state);
        }
        let others = tasks.iter().filter(|task| !task.is_ground_state);
        let others: Vec<_> =
            others.map(|task| (task.species.symbol(), task.prototype, task.facet, task.distance)).collect();
        assert_eq!(others[0], ("Al", Prototype::Bcc, None, 2.7));
        assert_eq!(others[3], ("W", Prototype::Fcc, Some(Facet::F111), 2.7));
    }
}
