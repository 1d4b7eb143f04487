//! The check of the reference: labels of structures with known energies, forces and stresses, compared with these
//! before the first walk starts.

use analysis::{EnergyOffsets, LabelledEnergy};
use atoms::cell::norm;
use atoms::{Matrix3, Structure};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use store::records::{Label, Protocol};
use store::{Store, StoreError};
use wire::ContentHash;

use crate::energy_offsets::labelled_energy;

/// Metadata key of the last check.
pub const METADATA_KEY: &str = "reference_check";

/// Minimum number of structures that must support a composition before its energy is judged. One alone would have no
/// difference from the offsets.
const MIN_SUPPORT: f64 = 2.0;

/// A structure with its known label.
#[derive(Clone, Debug)]
pub struct KnownStructure {
    /// `file:line`
    pub source: String,
    /// The structure.
    pub structure: Structure,
    /// Its energy, forces and, if known, stress by the reference that the potential was trained on.
    pub label: Label,
}

/// Largest differences that do not contradict the reference.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DifferenceBounds {
    /// eV/atom, after offsets of the elements.
    pub energy: f64,
    /// Length of the difference of an atom's force, eV/Å.
    pub force: f64,
    /// Component of the stress, eV/Å³.
    pub stress: f64,
}

/// State of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CheckState {
    /// Labels are being made.
    Running,
    /// All differences are within the bounds.
    Passed,
    /// A difference is above its bound, or a label failed.
    Failed,
    /// The same, and the user accepted it.
    Accepted,
}

/// A check and its results.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReferenceCheck {
    /// Its state.
    pub state: CheckState,
    /// Name of the label protocol.
    pub protocol: String,
    /// Hash of what it depends on: the protocol, the known labels and the bounds.
    pub identity: String,
    /// The bounds.
    pub bounds: DifferenceBounds,
    /// Number of structures.
    pub structures: usize,
    /// The frames compared so far.
    pub frames: Vec<FrameDifference>,
}

/// Differences of a structure's label from what is known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameDifference {
    /// `file:line`
    pub frame: String,
    /// Chemical formula.
    pub formula: String,
    /// E_label − E_known per atom after offsets of the elements, eV. `None` if too few frames determine the offsets
    /// of its elements.
    pub energy: Option<f64>,
    /// Largest length of a force difference, eV/Å. `None` without a label.
    pub force: Option<f64>,
    /// Root mean square over the components of the forces, eV/Å.
    pub force_rms: Option<f64>,
    /// Difference of a stress component with the largest absolute value, eV/Å³. `None` if either stress is unknown.
    pub stress: Option<f64>,
    /// Why there is no label.
    pub failure: Option<String>,
}

/// A quantity that a check compares.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CheckedQuantity {
    /// Energy, eV/atom.
    Energy,
    /// Force of an atom, eV/Å.
    Force,
    /// Component of the stress, eV/Å³.
    Stress,
}

/// What is wrong with a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CheckFault<'a> {
    /// It has no label.
    NoLabel {
        /// The frame.
        frame: &'a FrameDifference,
        /// Why not.
        reason: &'a str,
    },
    /// A difference is above its bound.
    AboveBound {
        /// The frame.
        frame: &'a FrameDifference,
        /// What differs.
        quantity: CheckedQuantity,
        /// The difference, in the unit of the quantity.
        found: f64,
        /// Its bound.
        bound: f64,
    },
}

/// A quantity of a check over all frames.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Overall {
    /// Root mean square over the frames: of the energies and stresses as they are shown, and of all force components.
    pub rms: f64,
    /// Largest absolute value.
    pub largest: f64,
    /// Number of frames that have it.
    pub frames: usize,
}

impl ReferenceCheck {
    /// The last check of a campaign.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn read(store: &Store) -> Result<Option<Self>, StoreError> {
        let text = store.metadata(METADATA_KEY).await?;
        let read = text.map(|text| serde_json::from_str(&text)).transpose();
        read.map_err(|error| StoreError::damaged("the reference check", error))
    }

    /// A check that begins.
    pub fn begin(protocol: &Protocol, known: &[KnownStructure], bounds: DifferenceBounds) -> Self {
        Self {
            state: CheckState::Running,
            protocol: protocol.name.clone(),
            identity: identity(protocol, known, &bounds),
            bounds,
            structures: known.len(),
            frames: Vec::new(),
        }
    }

    /// Adds what is known now: the labels of the first structures, or why they have none. The check ends when all
    /// structures are there.
    pub fn compare(&mut self, known: &[KnownStructure], labels: &[Result<Label, String>]) {
        let offsets = fit(known, labels);
        let difference = |(known, label): (&KnownStructure, &Result<Label, String>)| {
            FrameDifference::new(known, label, offsets.as_ref())
        };
        self.frames = known.iter().zip(labels).map(difference).collect();
        let has_faults = self.faults().next().is_some();
        self.state = match has_faults {
            _ if self.frames.len() < self.structures => CheckState::Running,
            true => CheckState::Failed,
            false => CheckState::Passed,
        };
    }

    /// What is wrong, by frame.
    pub fn faults(&self) -> impl Iterator<Item = CheckFault<'_>> {
        let DifferenceBounds { energy, force, stress } = self.bounds;
        self.frames.iter().flat_map(move |frame| {
            let above = |quantity: CheckedQuantity, found: Option<f64>, bound: f64| {
                let found = found.filter(|found| found.abs() > bound)?;
                Some(CheckFault::AboveBound { frame, quantity, found, bound })
            };
            let no_label = frame.failure.as_deref().map(|reason| CheckFault::NoLabel { frame, reason });
            [
                no_label,
                above(CheckedQuantity::Energy, frame.energy, energy),
                above(CheckedQuantity::Force, frame.force, force),
                above(CheckedQuantity::Stress, frame.stress, stress),
            ]
            .into_iter()
            .flatten()
        })
    }

    /// Number of frames with a label whose energy is not judged.
    pub fn unjudged_energies(&self) -> usize {
        self.frames.iter().filter(|frame| frame.force.is_some() && frame.energy.is_none()).count()
    }

    /// The JSON of `calmwalk status` (docs/status.md), without sentences for the faults.
    pub fn to_json(&self) -> Value {
        let mut json = json!(self);
        json["overall"] = json!({ "energy": self.energy(), "force": self.force(), "stress": self.stress() });
        json
    }

    /// The differences in energy over all frames, eV/atom.
    pub fn energy(&self) -> Option<Overall> {
        Overall::new(self.frames.iter().filter_map(|frame| Some((frame.energy?, frame.energy?))))
    }

    /// The differences in force over all frames, eV/Å.
    pub fn force(&self) -> Option<Overall> {
        Overall::new(self.frames.iter().filter_map(|frame| Some((frame.force_rms?, frame.force?))))
    }

    /// The differences in stress over all frames, eV/Å³.
    pub fn stress(&self) -> Option<Overall> {
        Overall::new(self.frames.iter().filter_map(|frame| Some((frame.stress?, frame.stress?))))
    }
}

impl FrameDifference {
    fn new(known: &KnownStructure, label: &Result<Label, String>, offsets: Option<&EnergyOffsets>) -> Self {
        let KnownStructure { source, structure, label: expected } = known;
        let mut difference = Self {
            frame: source.clone(),
            formula: structure.formula(),
            energy: None,
            force: None,
            force_rms: None,
            stress: None,
            failure: label.as_ref().err().cloned(),
        };
        let Ok(label) = label else { return difference };
        let energies = energies(structure, expected, label);
        difference.energy =
            offsets.and_then(|offsets| offsets.error_per_atom(&energies, MIN_SUPPORT)).map(|error| -error);
        let forces: Vec<[f64; 3]> = label
            .forces
            .iter()
            .zip(&expected.forces)
            .map(|(a, b)| std::array::from_fn(|axis| a[axis] - b[axis]))
            .collect();
        difference.force = Some(forces.iter().map(|force| norm(*force)).fold(0.0, f64::max));
        let squares: f64 = forces.iter().flatten().map(|x| x * x).sum();
        difference.force_rms = Some((squares / (3 * forces.len()).max(1) as f64).sqrt());
        difference.stress =
            label.stress.zip(expected.stress).map(|(found, known)| largest_difference(&found, &known));
        difference
    }
}

impl Overall {
    /// From the root mean square and the largest value of each frame.
    fn new(frames: impl Iterator<Item = (f64, f64)>) -> Option<Self> {
        let (mut squares, mut largest, mut count) = (0.0, 0.0_f64, 0);
        for (rms, value) in frames {
            squares += rms * rms;
            largest = largest.max(value.abs());
            count += 1;
        }
        (count > 0).then(|| Self { rms: (squares / count as f64).sqrt(), largest, frames: count })
    }
}

/// Offsets of the elements, fitted to the frames; `None` if there are too few.
fn fit(known: &[KnownStructure], labels: &[Result<Label, String>]) -> Option<EnergyOffsets> {
    let pairs = known.iter().zip(labels);
    let energies = pairs
        .filter_map(|(known, label)| Some(energies(&known.structure, &known.label, label.as_ref().ok()?)));
    EnergyOffsets::fit(&energies.collect::<Vec<_>>()).ok()
}

fn energies(structure: &Structure, known: &Label, label: &Label) -> LabelledEnergy {
    labelled_energy(structure, known.energy, label.energy)
}

fn largest_difference(found: &Matrix3, known: &Matrix3) -> f64 {
    let differences = found.iter().flatten().zip(known.iter().flatten()).map(|(a, b)| a - b);
    differences.fold(0.0, |largest: f64, x| if x.abs() > largest.abs() { x } else { largest })
}

fn identity(protocol: &Protocol, known: &[KnownStructure], bounds: &DifferenceBounds) -> String {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&protocol.hash.0);
    for number in [bounds.energy, bounds.force, bounds.stress] {
        hasher.update(&number.to_le_bytes());
    }
    hasher.update(&hash(known).0);
    hasher.finalize().to_string()
}

/// Hash of the structures and of what is known of them.
pub fn hash(known: &[KnownStructure]) -> ContentHash {
    let mut hasher = blake3::Hasher::new();
    for KnownStructure { structure, label, .. } in known {
        hasher.update(&ContentHash::from_structure(structure).0);
        let stress = label.stress.into_iter().flatten().flatten();
        let numbers = label.forces.iter().flatten().copied().chain(stress).chain([label.energy]);
        for number in numbers {
            hasher.update(&number.to_le_bytes());
        }
    }
    ContentHash(*hasher.finalize().as_bytes())
}

#[cfg(test)]
mod tests {
    use atoms::Cell;

    use super::*;

    const BOUNDS: DifferenceBounds = DifferenceBounds { energy: 0.005, force: 0.05, stress: 0.005 };

    fn known(symbols: &[&str], energy: f64) -> KnownStructure {
        let species: Vec<_> = symbols.iter().map(|symbol| symbol.parse().unwrap()).collect();
        let n = species.len();
        let structure = Structure {
            species,
            positions: (0..n).map(|k| [k as f64 * 2.0, 0.0, 0.0]).collect(),
            cell: Cell::orthorhombic(20.0, 20.0, 20.0),
            periodic: [true; 3],
        };
        let label = Label {
            energy,
            forces: vec![[0.1, 0.0, 0.0]; n],
            stress: Some([[0.01; 3]; 3]),
            details: Default::default(),
        };
        KnownStructure { source: format!("known.extxyz:{n}"), structure, label }
    }

    fn protocol() -> Protocol {
        let (hash, name) = (ContentHash([1; 32]), "pbe".to_owned());
        Protocol { hash, name, settings: serde_json::Value::Null }
    }

    fn checked(known: &[KnownStructure], labels: &[Result<Label, String>]) -> ReferenceCheck {
        let mut check = ReferenceCheck::begin(&protocol(), known, BOUNDS);
        check.compare(known, labels);
        check
    }

    fn four() -> Vec<KnownStructure> {
        let pairs: [(&[&str], f64); 4] =
            [(&["Al"], -3.0), (&["Al", "Al"], -6.2), (&["O", "O"], -9.0), (&["O", "O", "O"], -13.0)];
        pairs.map(|(symbols, energy)| known(symbols, energy)).into()
    }

    /// Labels with other zeros of energy.
    fn labels(known: &[KnownStructure]) -> Vec<Result<Label, String>> {
        let offset = |known: &KnownStructure| -> f64 {
            known.structure.species.iter().map(|s| if s.symbol() == "Al" { 50.0 } else { 400.0 }).sum()
        };
        known
            .iter()
            .map(|known| Ok(Label { energy: known.label.energy - offset(known), ..known.label.clone() }))
            .collect()
    }

    #[test]
    fn other_zeros_of_energy_are_no_difference() {
        let known = four();
        let check = checked(&known, &labels(&known));
        assert_eq!((check.state, check.unjudged_energies()), (CheckState::Passed, 0));
        assert!(check.energy().unwrap().largest < 1e-9);
        assert_eq!(check.force().unwrap(), Overall { rms: 0.0, largest: 0.0, frames: 4 });
        let unfinished = checked(&known, &labels(&known)[..3]);
        assert_eq!(unfinished.state, CheckState::Running);
    }

    #[test]
    fn each_difference_above_its_bound_is_reported_with_its_frame() {
        let known = four();
        let faults = |change: &dyn Fn(&mut Label)| {
            let mut labels = labels(&known);
            change(labels[3].as_mut().unwrap());
            let check = checked(&known, &labels);
            assert_eq!(check.state, CheckState::Failed);
            let above = |fault: CheckFault<'_>| match fault {
                CheckFault::AboveBound { frame, quantity, found, bound } => {
                    (frame.frame.clone(), quantity, (1e4 * found).round() / 1e4, bound)
                }
                CheckFault::NoLabel { reason, .. } => panic!("{reason}"),
            };
            check.faults().map(above).collect::<Vec<_>>()
        };
        // The offset of O takes half of it.
        let energy = faults(&|label| label.energy += 3.0 * 0.04);
        let third = || "known.extxyz:3".to_owned();
        assert_eq!(energy.len(), 2, "{energy:?}");
        assert_eq!(energy[1], (third(), CheckedQuantity::Energy, 0.02, 0.005));
        let force = faults(&|label| label.forces[1] = [0.1, 0.3, 0.4]);
        assert_eq!(force, [(third(), CheckedQuantity::Force, 0.5, 0.05)]);
        let stress = faults(&|label| label.stress = Some([[0.01, 0.01, -0.01], [0.01; 3], [0.01; 3]]));
        assert_eq!(stress, [(third(), CheckedQuantity::Stress, -0.02, 0.005)]);
        let mut failed = labels(&known);
        failed[1] = Err("crashed: so".to_owned());
        let check = checked(&known, &failed);
        let fault = CheckFault::NoLabel { frame: &check.frames[1], reason: "crashed: so" };
        assert_eq!(check.faults().collect::<Vec<_>>(), [fault]);
    }

    #[test]
    fn energies_that_offsets_would_absorb_are_not_judged() {
        let known = [known(&["Al", "O"], -8.0), known(&["Al", "Al"], -6.0)];
        let mut wrong = labels(&known);
        wrong[0].as_mut().unwrap().energy += 7.0;
        let check = checked(&known, &wrong);
        assert_eq!((check.state, check.unjudged_energies(), check.energy()), (CheckState::Passed, 2, None));
        // A stress that one side lacks is not judged either.
        let mut partial = labels(&known);
        partial[0].as_mut().unwrap().stress = None;
        assert_eq!(checked(&known, &partial).stress().unwrap().frames, 1);
    }

    #[test]
    fn the_identity_depends_on_protocol_labels_and_bounds() {
        let (known, mut other) = (four(), four());
        other[2].label.forces[0][1] = 1e-9;
        let identity = |known: &[KnownStructure]| checked(known, &labels(known)).identity;
        assert_eq!(identity(&known), identity(&four()));
        assert_ne!(identity(&known), identity(&other));
        let mut protocol = protocol();
        let begun = |protocol: &Protocol, bounds| ReferenceCheck::begin(protocol, &known, bounds).identity;
        assert_eq!(begun(&protocol, BOUNDS), identity(&known));
        assert_ne!(begun(&protocol, DifferenceBounds { force: 0.1, ..BOUNDS }), identity(&known));
        protocol.hash = ContentHash([2; 32]);
        assert_ne!(begun(&protocol, BOUNDS), identity(&known));
    }
}
