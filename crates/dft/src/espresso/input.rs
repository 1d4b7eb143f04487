//! Writes `run.in`.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use atoms::{Species, Vec3, units};

use super::pseudopotentials::UpfFile;
use super::{Espresso, EspressoSettings, RYDBERG};
use crate::padded_structure::PaddedStructure;
use crate::pinned_file::DATA_DIRECTORY;
use crate::{CalculationInput, Failure, FailureClass, RetryAdjustment, SetupError, Smearing, moments};

/// Name of the input file.
const NAME: &str = "run.in";

/// Length in which lattice vectors are written and printed, bohr: with one of the usual size, the output would have
/// fewer digits, and below 1.9 `pw.x` prints a warning.
const LENGTH_UNIT: f64 = 2.0;

/// Largest initial polarisation of an element. From version 7.3 on, `pw.x` takes 1 for a moment in μ_B.
const MAX_POLARISATION: f64 = 0.999;

/// `pw.x` has tables of this length.
const MAX_ELEMENTS: usize = 10;

pub(super) fn write(
    code: &Espresso,
    padded: &PaddedStructure,
    adjustments: &BTreeSet<RetryAdjustment>,
) -> Result<CalculationInput, Failure> {
    let bad = |message: String| FailureClass::BadInput.with_message(message);
    let species = BTreeSet::from_iter(padded.structure.species.iter().copied());
    if species.len() > MAX_ELEMENTS {
        return Err(bad(format!("{} elements, more than the {MAX_ELEMENTS} of pw.x", species.len())));
    }
    let files = species.into_iter().map(|species| Ok((species, code.pseudopotential(species)?)));
    let files: Result<BTreeMap<Species, &UpfFile>, SetupError> = files.collect();
    let files = files.map_err(|error| bad(error.to_string()))?;
    let text = [
        control(),
        system(&code.settings, padded, &files, adjustments),
        electrons(&code.settings, adjustments),
        structure(&code.settings, padded, &files),
    ];
    Ok(CalculationInput {
        files: [(NAME.to_owned(), text.concat().into_bytes())].into(),
        command: code
            .settings
            .command
            .iter()
            .map(String::as_str)
            .chain(["-in", NAME])
            .map(str::to_owned)
            .collect(),
        environment: code.environment.clone(),
        data: files.into_iter().map(|(species, file)| (copy(species), file.pinned.clone())).collect(),
    })
}

/// File name of the copy of a pseudopotential.
fn copy(species: Species) -> String {
    format!("{species}.UPF")
}

/// Forces and stress, and occupation numbers in the output. Wave functions, which `pw.x` leaves if it does not converge,
/// go where nothing is kept.
fn control() -> String {
    format!(
        "&CONTROL\n  calculation = 'scf'\n  prefix = 'run'\n  outdir = '{DATA_DIRECTORY}'\n  pseudo_dir = '{DATA_DIRECTORY}'\n  \
         disk_io = 'none'\n  verbosity = 'high'\n  tprnfor = .true.\n  tstress = .true.\n/\n"
    )
}

fn system(
    settings: &EspressoSettings,
    padded: &PaddedStructure,
    files: &BTreeMap<Species, &UpfFile>,
    adjustments: &BTreeSet<RetryAdjustment>,
) -> String {
    let structure = &padded.structure;
    let smearing = match settings.smearing {
        Smearing::FermiDirac => "fermi-dirac",
        Smearing::MethfesselPaxton => "methfessel-paxton",
        Smearing::Gaussian => "gaussian",
    };
    let mut text = format!(
        "&SYSTEM\n  ibrav = 0\n  celldm(1) = {LENGTH_UNIT:?}\n  nat = {}\n  ntyp = {}\n  nbnd = {}\n  ecutwfc = {:?}\n  \
         ecutrho = {:?}\n  input_dft = 'PBE'\n  nosym = .true.\n  occupations = 'smearing'\n  smearing = '{smearing}'\n  \
         degauss = {:?}\n",
        structure.len(),
        files.len(),
        bands(settings, padded, files),
        settings.cutoff / RYDBERG,
        settings.density_cutoff() / RYDBERG,
        settings.smearing_width / RYDBERG,
    );
    if settings.spin_polarized {
        text += "  nspin = 2\n";
        let moments = moments::initial(structure, &settings.initial_magnetic_moments, adjustments);
        for (number, (species, file)) in files.iter().enumerate() {
            // Moments are by element, so any of its atoms has the element's.
            let atom = structure.species.iter().position(|other| other == species).unwrap_or_default();
            let polarisation = (moments[atom] / file.valence).clamp(-MAX_POLARISATION, MAX_POLARISATION);
            text += &format!("  starting_magnetization({}) = {polarisation:?}\n", number + 1);
        }
    }
    text + "/\n"
}

/// Number of bands.
fn bands(settings: &EspressoSettings, padded: &PaddedStructure, files: &BTreeMap<Species, &UpfFile>) -> u64 {
    let structure = &padded.structure;
    let electrons: f64 = structure.species.iter().filter_map(|s| files.get(s)).map(|file| file.valence).sum();
    let table = settings.spin_polarized.then_some(&settings.initial_magnetic_moments);
    moments::bands(structure, table, electrons)
}

fn electrons(settings: &EspressoSettings, adjustments: &BTreeSet<RetryAdjustment>) -> String {
    let factor = if adjustments.contains(&RetryAdjustment::MoreSteps) { 3 } else { 1 };
    let mut text = format!(
        "&ELECTRONS\n  conv_thr = {:?}\n  electron_maxstep = {}\n",
        settings.energy_tolerance / RYDBERG,
        settings.max_scf_steps.saturating_mul(factor)
    );
    if adjustments.contains(&RetryAdjustment::SlowerMixing) {
        text += "  mixing_beta = 0.2\n";
    }
    if adjustments.contains(&RetryAdjustment::OtherAlgorithm) {
        text += "  diagonalization = 'cg'\n  mixing_mode = 'local-TF'\n";
    }
    text + "/\n"
}

fn structure(
    settings: &EspressoSettings,
    padded: &PaddedStructure,
    files: &BTreeMap<Species, &UpfFile>,
) -> String {
    let structure = &padded.structure;
    let mut text = "ATOMIC_SPECIES\n".to_owned();
    for species in files.keys() {
        text += &format!("  {species} 1.0 {}\n", copy(*species));
    }
    text += "CELL_PARAMETERS alat\n";
    structure.cell.0.iter().for_each(|row| vector(&mut text, "", *row));
    text += "ATOMIC_POSITIONS alat\n";
    for (species, position) in structure.species.iter().zip(&structure.positions) {
        vector(&mut text, species.symbol(), *position);
    }
    let [x, y, z] = padded.mesh(settings.k_spacing);
    text + &format!("K_POINTS automatic\n  {x} {y} {z} 0 0 0\n")
}

/// Writes a vector, Å, with all digits.
fn vector(text: &mut String, begin: &str, vector: Vec3) {
    let [x, y, z] = vector.map(|x| x / (units::BOHR * LENGTH_UNIT));
    // Writing to a string cannot fail.
    let _ = writeln!(text, "  {begin} {x:?} {y:?} {z:?}");
}
