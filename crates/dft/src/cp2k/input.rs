//! Writes `run.inp`.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use atoms::Structure;

use super::{Cp2k, Cp2kSettings, OUTPUT, data};
use crate::padded_structure::PaddedStructure;
use crate::{CalculationInput, Failure, FailureClass, RetryAdjustment, moments};

/// Name of the input file.
const NAME: &str = "run.inp";

pub(super) fn write(
    cp2k: &Cp2k,
    padded: &PaddedStructure,
    adjustments: &BTreeSet<RetryAdjustment>,
) -> Result<CalculationInput, Failure> {
    let species = BTreeSet::from_iter(padded.structure.species.iter().copied());
    // Only the entries that the identity contains.
    let (mut potentials, mut bases) = (String::new(), String::new());
    for species in species {
        let kind =
            cp2k.kind(species).map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
        potentials += &format!("{}\n", kind.entries.potential);
        bases += &format!("{}\n", kind.entries.basis);
    }
    let spins = Spins::new(cp2k, &padded.structure, adjustments);
    let text = format!(
        "&GLOBAL\n  PROJECT run\n  RUN_TYPE ENERGY_FORCE\n  PRINT_LEVEL MEDIUM\n&END GLOBAL\n&FORCE_EVAL\n  METHOD \
         QUICKSTEP\n  STRESS_TENSOR ANALYTICAL\n  &PRINT\n    &FORCES\n    &END FORCES\n    &STRESS_TENSOR\n    &END \
         STRESS_TENSOR\n  &END PRINT\n  &DFT\n{}{}{}  &END DFT\n  &SUBSYS\n{}  &END SUBSYS\n&END FORCE_EVAL\n",
        method(&cp2k.settings, &spins),
        k_points(padded.mesh(cp2k.settings.k_spacing)),
        steps(&cp2k.settings, &spins, adjustments),
        structure(cp2k, &padded.structure, adjustments),
    );
    let arguments = ["-i", NAME, "-o", OUTPUT].map(str::to_owned);
    Ok(CalculationInput {
        files: [(NAME, text), (data::POTENTIALS, potentials), (data::BASES, bases)]
            .map(|(name, text)| (name.to_owned(), text.into_bytes()))
            .into(),
        command: cp2k.settings.command.iter().cloned().chain(arguments).collect(),
        environment: cp2k.environment.clone(),
        ..CalculationInput::default()
    })
}

/// Electrons and orbitals in CP2K's input.
struct Spins {
    /// Initial 2 S + 1; smearing lets the moment relax.
    multiplicity: u64,
    /// Empty orbitals of each spin.
    empty: [u64; 2],
}

impl Spins {
    fn new(cp2k: &Cp2k, structure: &Structure, adjustments: &BTreeSet<RetryAdjustment>) -> Self {
        let electrons = cp2k.electrons(structure).round() as u64;
        let initial =
            |adjustments| moments::initial(structure, &cp2k.settings.initial_magnetic_moments, adjustments);
        let sum = |moments: Vec<f64>| {
            if cp2k.settings.spin_polarized { moments.iter().sum::<f64>().abs() } else { 0.0 }
        };
        let parity = electrons % 2;
        // The nearest value that this number of electrons allows.
        let unpaired =
            2 * ((sum(initial(adjustments)) - parity as f64) / 2.0).round().max(0.0) as u64 + parity;
        let unpaired = if cp2k.settings.spin_polarized { unpaired.min(electrons) } else { 0 };
        // The same number of orbitals for every retry adjustment.
        let orbitals = (0.6 * (electrons as f64 + sum(initial(&BTreeSet::new())))).ceil() as u64 + 4;
        let occupied = [electrons.div_ceil(2) + unpaired / 2, (electrons / 2).saturating_sub(unpaired / 2)];
        Self { multiplicity: unpaired + 1, empty: occupied.map(|n| orbitals.saturating_sub(n).max(1)) }
    }
}

fn method(settings: &Cp2kSettings, spins: &Spins) -> String {
    let spin = match settings.spin_polarized {
        true => format!("    UKS T\n    MULTIPLICITY {}\n", spins.multiplicity),
        false => String::new(),
    };
    format!(
        "    BASIS_SET_FILE_NAME {}\n    POTENTIAL_FILE_NAME {}\n{spin}    &QS\n      EPS_DEFAULT \
         1.0E-12\n    &END QS\n    &MGRID\n      CUTOFF [eV] {:?}\n      REL_CUTOFF [eV] {:?}\n    &END MGRID\n    &XC\n      \
         &XC_FUNCTIONAL PBE\n      &END XC_FUNCTIONAL\n    &END XC\n    &PRINT\n      &MULLIKEN\n      &END MULLIKEN\n    \
         &END PRINT\n",
        data::BASES,
        data::POTENTIALS,
        settings.cutoff,
        settings.relative_cutoff
    )
}

/// Γ alone needs no section. MacDonald's shift puts Γ on meshes of even size.
fn k_points(mesh: [u32; 3]) -> String {
    if mesh == [1; 3] {
        return String::new();
    }
    let [x, y, z] = mesh;
    let [a, b, c] = mesh.map(|n| if n % 2 == 0 { 0.5 / f64::from(n) } else { 0.0 });
    format!(
        "    &KPOINTS\n      SCHEME MACDONALD {x} {y} {z} {a:?} {b:?} {c:?}\n      SYMMETRY OFF\n    &END KPOINTS\n"
    )
}

fn steps(settings: &Cp2kSettings, spins: &Spins, adjustments: &BTreeSet<RetryAdjustment>) -> String {
    let has = |adjustment| adjustments.contains(&adjustment);
    let steps = settings.max_scf_steps.saturating_mul(if has(RetryAdjustment::MoreSteps) { 3 } else { 1 });
    // Broyden's method stagnates below 0.2. Pulay's oscillates or stops at a bad condition number even in
    // simple cases, and with Kerker's CP2K reports convergence far too early.
    let careful = has(RetryAdjustment::SlowerMixing) || has(RetryAdjustment::OtherAlgorithm);
    let (alpha, memory) =
        (if careful { 0.2 } else { 0.4 }, if has(RetryAdjustment::OtherAlgorithm) { 4 } else { 8 });
    let mixing = format!("METHOD BROYDEN_MIXING\n        ALPHA {alpha:?}\n        NBROYDEN {memory}");
    let [up, down] = spins.empty;
    let empty = if settings.spin_polarized { format!("{up} {down}") } else { up.to_string() };
    let temperature = settings.smearing_width / atoms::units::BOLTZMANN;
    format!(
        "    &SCF\n      SCF_GUESS ATOMIC\n      EPS_SCF {:?}\n      MAX_SCF {steps}\n      ADDED_MOS {empty}\n      \
         &SMEAR\n        METHOD FERMI_DIRAC\n        ELECTRONIC_TEMPERATURE [K] {temperature:?}\n      &END SMEAR\n      \
         &MIXING\n        {mixing}\n      &END MIXING\n    &END SCF\n",
        settings.density_tolerance
    )
}

fn structure(cp2k: &Cp2k, structure: &Structure, adjustments: &BTreeSet<RetryAdjustment>) -> String {
    let mut text = "    &CELL\n".to_owned();
    // Writing to a string cannot fail.
    for (name, [x, y, z]) in ["A", "B", "C"].iter().zip(structure.cell.0) {
        let _ = writeln!(text, "      {name} {x:?} {y:?} {z:?}");
    }
    text += "    &END CELL\n    &COORD\n";
    for (species, [x, y, z]) in structure.species.iter().zip(&structure.positions) {
        let _ = writeln!(text, "      {species} {x:?} {y:?} {z:?}");
    }
    text += "    &END COORD\n";
    let initial = moments::initial(structure, &cp2k.settings.initial_magnetic_moments, adjustments);
    let moments = BTreeMap::from_iter(structure.species.iter().zip(initial));
    for (species, moment) in moments {
        let potential = cp2k.kind(*species).map_or("", |kind| kind.potential.as_str());
        let _ = writeln!(
            text,
            "    &KIND {species}\n      BASIS_SET {}\n      POTENTIAL {potential}",
            cp2k.settings.basis
        );
        if cp2k.settings.spin_polarized {
            let _ = writeln!(text, "      MAGNETIZATION {moment:?}");
        }
        text += "    &END KIND\n";
    }
    text
}
