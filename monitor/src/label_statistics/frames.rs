//! What the comparison of biased and control walks keeps of labelled and failed structures.

use std::collections::BTreeMap;

use analysis::{GroupSample, SystematicSample};
use atoms::cell::{norm, sub};
use atoms::{Matrix3, Species, Structure, Vec3};
use store::{FailedCandidate, LabelledCandidate};
use wire::{ContentHash, Origin};

/// Largest number of labelled, and of failed, structures that are kept, 150 bytes each. Beyond it, a sample of whole walks is kept, the
/// same walks of both.
const MAX_FRAMES: usize = 1 << 17;
/// Largest number of atoms that are kept, 56 bytes each. Beyond it, a systematic sample is kept.
const MAX_ATOMS: usize = 1 << 18;

/// Labelled and failed structures of biased and control walks.
#[derive(Clone, Debug)]
pub(super) struct ComparedFrames {
    labelled: GroupSample<ComparedFrame>,
    pub atoms: SystematicSample<ComparedAtom>,
    failed: GroupSample<FailedFrame>,
    /// Number of label jobs that wait or are in work.
    pub unfinished: u64,
    /// Of each control walk, its biased walk.
    matched_walks: BTreeMap<u32, u32>,
}

/// Where a structure comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FramePlace {
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// The biased walk; for a control frame, the one that its walk matches.
    pub walk: u32,
    pub origin: Origin,
}

/// A labelled structure.
#[derive(Clone, Debug)]
pub(super) struct ComparedFrame {
    pub place: FramePlace,
    /// Segment and step of its walk, which has one structure there.
    pub at: (u32, u64),
    pub content: ContentHash,
    /// Both a biased walk and a control walk found it.
    pub is_shared: bool,
    /// Whether the queue chose its label by value.
    pub by_value: bool,
    pub errors: FrameErrors,
    /// Kinetic temperature, K.
    pub temperature: f64,
    /// V/V₀.
    pub relative_volume: f64,
}

/// Errors of the potential for a structure; `None` where they are not known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FrameErrors {
    /// Mean absolute error of the force components, eV/Å.
    pub force_mae: Option<f64>,
    /// Mean of |F_model − F_label| over the atoms, eV/Å.
    pub mean_force_error: Option<f64>,
    /// |E_model − E_label| per atom without the offsets of the elements, eV.
    pub energy: Option<f64>,
    /// Root mean square error of the six components of the stress, eV/Å³.
    pub stress: Option<f64>,
}

/// An atom of a labelled structure.
#[derive(Clone, Copy, Debug)]
pub(super) struct ComparedAtom {
    pub place: FramePlace,
    /// As [`ComparedFrame::at`].
    pub at: (u32, u64),
    pub is_shared: bool,
    pub species: Species,
    /// γ under the original mixture.
    pub gamma: f64,
    /// γ_nbr under the original mixture.
    pub gamma_nbr: f64,
    /// |F_model − F_label|, eV/Å.
    pub error: f64,
}

/// A structure whose label failed.
#[derive(Clone, Copy, Debug)]
pub(super) struct FailedFrame {
    pub origin: Origin,
    /// As [`FramePlace::walk`].
    pub walk: u32,
    pub step: u64,
    pub content: ContentHash,
    /// As [`ComparedFrame::is_shared`].
    pub is_shared: bool,
}

impl ComparedFrames {
    /// Nothing yet. `matched_walks`: of each control walk, its biased walk.
    pub fn new(matched_walks: BTreeMap<u32, u32>) -> Self {
        Self {
            labelled: GroupSample::new(MAX_FRAMES),
            atoms: SystematicSample::new(MAX_ATOMS),
            failed: GroupSample::new(MAX_FRAMES),
            unfinished: 0,
            matched_walks,
        }
    }

    /// Adds a labelled candidate with the error of its energy per atom, eV. `is_shared`: walks of both origins found it. Its atoms
    /// are then those of the biased walk. Atoms without finite grades and error are left out.
    pub fn add(&mut self, row: &LabelledCandidate, is_shared: bool, energy_error: Option<f64>) {
        let LabelledCandidate { seed_structure, block, original, .. } = row;
        let view = block.view();
        let origin = view.origin();
        let id = view.id();
        let walk = self.biased_walk(id.walk.0);
        let place = FramePlace { seed_structure: *seed_structure, walk, origin };
        let differences = view.forces.iter().zip(&row.label.forces);
        let differences: Vec<Vec3> = differences.map(|(model, label)| sub(*model, *label)).collect();
        if !(is_shared && origin == Origin::Control) {
            let grades = original.gamma.iter().zip(&original.gamma_nbr);
            for ((species, (gamma, gamma_nbr)), difference) in
                row.structure.species.iter().zip(grades).zip(&differences)
            {
                let (species, gamma, gamma_nbr, error) = (*species, *gamma, *gamma_nbr, norm(*difference));
                if [gamma, gamma_nbr, error].into_iter().all(f64::is_finite) {
                    let at = (id.segment, id.step);
                    let atom = ComparedAtom { place, at, is_shared, species, gamma, gamma_nbr, error };
                    self.atoms.add(atom);
                }
            }
        }
        let errors = FrameErrors {
            force_mae: mean(differences.iter().flatten().map(|component| component.abs())),
            mean_force_error: mean(differences.iter().map(|difference| norm(*difference))),
            energy: energy_error.map(f64::abs),
            stress: row.label.stress.and_then(|label| stress_error(&row.structure, view.virial(), label)),
        };
        let frame = ComparedFrame {
            place,
            at: (id.segment, id.step),
            content: id.content,
            is_shared,
            by_value: row.label.details.ordered_by_value,
            errors,
            temperature: view.temperature(),
            relative_volume: view.relative_volume(),
        };
        self.add_labelled(frame);
    }

    /// Adds a labelled structure.
    pub fn add_labelled(&mut self, frame: ComparedFrame) {
        self.labelled.add(u64::from(frame.place.walk), frame);
        self.labelled.thin_together(&mut self.failed);
    }

    /// Adds a candidate whose label failed. `is_shared`: walks of both origins found it.
    pub fn add_failed(&mut self, candidate: &FailedCandidate, is_shared: bool) {
        let FailedCandidate { origin, walk, step, content, .. } = candidate;
        let walk = self.biased_walk(*walk);
        self.add_failed_frame(FailedFrame {
            origin: *origin,
            walk,
            step: *step,
            content: *content,
            is_shared,
        });
    }

    /// Adds a structure whose label failed.
    pub fn add_failed_frame(&mut self, frame: FailedFrame) {
        self.failed.add(u64::from(frame.walk), frame);
        self.failed.thin_together(&mut self.labelled);
    }

    /// The labelled structures that are kept.
    pub fn labelled(&self) -> impl ExactSizeIterator<Item = &ComparedFrame> {
        self.labelled.items()
    }

    /// The structures without a label that are kept.
    pub fn failed(&self) -> impl ExactSizeIterator<Item = &FailedFrame> {
        self.failed.items()
    }

    /// Number of labelled structures that were added.
    pub fn labelled_in_all(&self) -> u64 {
        self.labelled.total()
    }

    /// The walk itself if it is biased.
    fn biased_walk(&self, walk: u32) -> u32 {
        self.matched_walks.get(&walk).copied().unwrap_or(walk)
    }
}

/// The six components of the stress by the model and by the label, eV/Å³. `None` unless the structure is periodic in three directions.
pub(super) fn stress_components(
    structure: &Structure,
    virial: Matrix3,
    label: Matrix3,
) -> Option<[[f64; 2]; 6]> {
    let volume = structure.cell.volume();
    if structure.periodic != [true; 3] || volume <= 0.0 {
        return None;
    }
    let symmetric = |of: &Matrix3, i: usize, j: usize| 0.5 * (of[i][j] + of[j][i]);
    let component = |(i, j)| [-symmetric(&virial, i, j) / volume, symmetric(&label, i, j)];
    Some([(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)].map(component))
}

/// Root mean square difference of the six components of the stress, eV/Å³. `None` unless the structure is periodic in three
/// directions.
pub(crate) fn stress_error(structure: &Structure, virial: Matrix3, label: Matrix3) -> Option<f64> {
    let components = stress_components(structure, virial, label)?;
    mean(components.iter().map(|[model, label]| (model - label).powi(2))).map(f64::sqrt)
}

/// Mean of finite values; `None` without values, or with one that is not finite.
pub(crate) fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (number, sum) = values.fold((0_u64, 0.0), |(number, sum), x| (number + 1, sum + x));
    let mean = sum / number as f64;
    mean.is_finite().then_some(mean)
}

#[cfg(test)]
mod tests {
    use atoms::Cell;

    use super::*;

    #[test]
    fn stress_errors_are_of_six_components() {
        let structure = Structure {
            species: vec!["Al".parse().unwrap()],
            positions: vec![[0.0; 3]],
            cell: Cell::orthorhombic(2.0, 2.0, 5.0),
            periodic: [true; 3],
        };
        // The model's stress is −virial / 20 Å³.
        let mut virial = [[0.0; 3]; 3];
        virial[0][0] = -2.0;
        let mut label = [[0.0; 3]; 3];
        (label[0][0], label[1][2], label[2][1]) = (0.4, 0.3, 0.3);
        let found = stress_error(&structure, virial, label).unwrap();
        // numpy.sqrt(numpy.mean([0.3**2, 0, 0, 0.3**2, 0, 0]))
        assert!((found - 0.173_205_080_756_887_7).abs() < 1e-12, "{found}");
        let cluster = Structure { periodic: [true, true, false], ..structure };
        assert_eq!(stress_error(&cluster, virial, label), None);
    }

    #[test]
    fn means_are_of_finite_values() {
        assert_eq!(mean([1.0, 2.0].into_iter()), Some(1.5));
        assert_eq!((mean([].into_iter()), mean([1.0, f64::NAN].into_iter())), (None, None));
    }
}
