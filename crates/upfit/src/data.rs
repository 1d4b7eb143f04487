//! Labelled structures, checked before any work.

use atoms::extxyz::FrameLabels;
use atoms::{Matrix3, Structure, Vec3};

use crate::error::UpfitError;
use crate::frame_fault::{FrameFault, MAX_FORCE};

/// A structure with its labels.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledFrame {
    /// Where it comes from, such as `data.extxyz:110`.
    pub place: String,
    /// Its seed structure, or another name of the structures that belong together. [`crate::split`] divides no group.
    pub group: String,
    /// Number of the file that it comes from. [`crate::split`] divides each file by itself.
    pub file: usize,
    /// The structure.
    pub structure: Structure,
    /// Total energy, eV.
    pub energy: f64,
    /// `[n]`, eV/Å.
    pub forces: Vec<Vec3>,
    /// ∂E/∂ε / volume, eV/Å³ (tension positive); only for structures that are periodic in all three directions.
    pub stress: Option<Matrix3>,
    /// Factor on its terms of the loss.
    pub weight: f64,
}

/// Structures to train with, and those that are only measured.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrainingData {
    /// Structures to train with.
    pub training: Vec<LabelledFrame>,
    /// Structures that choose the best weights; may be empty.
    pub validation: Vec<LabelledFrame>,
}

impl LabelledFrame {
    /// A structure with these labels. Stresses of slabs, wires and molecules are left out, since they refer to a volume that is
    /// arbitrary.
    ///
    /// # Errors
    /// An invalid structure or weight, labels without energy or forces, numbers that are not finite, forces above [`MAX_FORCE`].
    pub fn new(
        place: String,
        group: String,
        structure: Structure,
        labels: FrameLabels,
        weight: f64,
    ) -> Result<Self, UpfitError> {
        match checked(&structure, labels, weight) {
            Ok((energy, forces, stress)) => {
                Ok(Self { place, group, file: 0, structure, energy, forces, stress, weight })
            }
            Err(fault) => Err(UpfitError::Frame { place, fault }),
        }
    }

    /// The error that names this structure.
    pub(crate) fn wrong(&self, fault: FrameFault) -> UpfitError {
        UpfitError::Frame { place: self.place.clone(), fault }
    }

    fn hash_into(&self, hasher: &mut blake3::Hasher) {
        let Structure { species, positions, cell, periodic } = &self.structure;
        hasher.update(&(species.len() as u64).to_le_bytes());
        for species in species {
            hasher.update(&[species.atomic_number()]);
        }
        hasher.update(&periodic.map(u8::from));
        hasher.update(&[u8::from(self.stress.is_some())]);
        let stress = self.stress.unwrap_or_default();
        let numbers = positions.as_flattened().iter().chain(cell.0.as_flattened());
        let numbers = numbers.chain(self.forces.as_flattened()).chain(stress.as_flattened());
        for number in numbers.chain([&self.energy, &self.weight]) {
            hasher.update(&number.to_le_bytes());
        }
    }
}

/// BLAKE3 hash of structures, labels and weights, in this order; names and places do not count.
pub fn data_hash(frames: &[LabelledFrame]) -> String {
    let mut hasher = blake3::Hasher::new();
    frames.iter().for_each(|frame| frame.hash_into(&mut hasher));
    hasher.finalize().to_string()
}

/// Energy, forces and stress, checked.
fn checked(
    structure: &Structure,
    labels: FrameLabels,
    weight: f64,
) -> Result<(f64, Vec<Vec3>, Option<Matrix3>), FrameFault> {
    structure.validate()?;
    let forces = labels.forces.ok_or(FrameFault::NoForces)?;
    let energy = labels.energy.ok_or(FrameFault::NoEnergy)?;
    let stress = labels.stress.filter(|_| structure.periodic == [true; 3]);
    if forces.len() != structure.len() {
        return Err(FrameFault::NumberOfForces { forces: forces.len(), atoms: structure.len() });
    }
    let is_finite = |numbers: &[f64]| numbers.iter().all(|x| x.is_finite());
    let stress_is_finite = stress.is_none_or(|stress| is_finite(stress.as_flattened()));
    for (what, finite) in [
        ("the energy", energy.is_finite()),
        ("a force", is_finite(forces.as_flattened())),
        ("the stress", stress_is_finite),
    ] {
        if !finite {
            return Err(FrameFault::NotFinite(what));
        }
    }
    let sizes = forces.iter().map(|force| atoms::cell::norm(*force)).enumerate();
    if let Some((atom, size)) = sizes.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, size)| *size > MAX_FORCE)
    {
        return Err(FrameFault::LargeForce { atom, size });
    }
    if !(weight.is_finite() && weight >= 0.0) {
        return Err(FrameFault::Weight(weight));
    }
    Ok((energy, forces, stress))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_frames::aluminium;

    fn labels(frame: &LabelledFrame) -> FrameLabels {
        FrameLabels { energy: Some(frame.energy), forces: Some(frame.forces.clone()), stress: frame.stress }
    }

    fn refused(change: impl FnOnce(&mut FrameLabels)) -> String {
        let frame = aluminium(1).remove(0);
        let mut labels = labels(&frame);
        change(&mut labels);
        let made = LabelledFrame::new("data.extxyz:7".into(), "a".into(), frame.structure, labels, 1.0);
        made.unwrap_err().to_string()
    }

    #[test]
    fn wrong_labels_are_named() {
        for (message, expected) in [
            (refused(|labels| labels.forces = None), "data.extxyz:7: the structure has no forces"),
            (refused(|labels| labels.energy = None), "has no energy"),
            (refused(|labels| labels.forces.as_mut().unwrap().truncate(107)), "107 forces"),
            (refused(|labels| labels.energy = Some(f64::NAN)), "the energy of the labels is not finite"),
            (
                refused(|labels| labels.forces.as_mut().unwrap()[3][1] = f64::INFINITY),
                "a force of the labels",
            ),
            (refused(|labels| labels.stress = Some([[f64::NAN; 3]; 3])), "the stress of the labels"),
            (
                refused(|labels| labels.forces.as_mut().unwrap()[5] = [0.0, 3e3, 4e3]),
                "the force on atom 5 is 5.0000e3 eV/Å, expected at most 1000 eV/Å",
            ),
        ] {
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn stresses_of_slabs_are_left_out() {
        let frame = aluminium(1).remove(0);
        assert!(frame.stress.is_some());
        let mut slab = frame.structure.clone();
        slab.periodic = [true, true, false];
        let made = LabelledFrame::new("x".into(), "a".into(), slab, labels(&frame), 1.0).unwrap();
        assert_eq!((made.stress, atoms::composition(&made.structure.species)), (None, vec![(13, 108)]));
    }

    #[test]
    fn the_hash_follows_every_number() {
        let frames = aluminium(2);
        let hash = data_hash(&frames);
        assert_eq!(hash, data_hash(&frames));
        let changes: [fn(&mut LabelledFrame); 5] = [
            |frame| frame.energy += 1e-9,
            |frame| frame.weight = 0.5,
            |frame| frame.stress = None,
            |frame| frame.forces[3][2] += 1e-9,
            |frame| frame.structure.positions[3][2] += 1e-9,
        ];
        for change in changes {
            let mut changed = frames.clone();
            change(&mut changed[1]);
            assert_ne!(data_hash(&changed), hash);
        }
        let mut renamed = frames;
        renamed[0].place = "elsewhere".into();
        assert_eq!(data_hash(&renamed), hash);
    }
}
