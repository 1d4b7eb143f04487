//! Writes `run.abi`.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use atoms::{Species, Vec3};

use super::pseudopotentials::Pseudopotential;
use super::{Abinit, AbinitSettings};
use crate::padded_structure::PaddedStructure;
use crate::pinned_file::DATA_DIRECTORY;
use crate::{CalculationInput, Failure, FailureClass, RetryAdjustment, Smearing, moments};

/// Name of the input file; ABINIT derives the name of its output from it.
const NAME: &str = "run.abi";

pub(super) fn write(
    abinit: &Abinit,
    padded: &PaddedStructure,
    adjustments: &BTreeSet<RetryAdjustment>,
) -> Result<CalculationInput, Failure> {
    let bad = |error: crate::SetupError| FailureClass::BadInput.with_message(error.to_string());
    let species = BTreeSet::from_iter(padded.structure.species.iter().copied());
    let pseudopotentials = abinit.matching_pseudopotentials(&species).map_err(bad)?;
    let mut text = fixed(&abinit.settings);
    electrons(&mut text, &abinit.settings, padded, &pseudopotentials, adjustments);
    steps(&mut text, &abinit.settings, pseudopotentials.values().any(|p| p.paw), adjustments);
    structure(&mut text, padded, &pseudopotentials);
    let copies: Vec<_> = pseudopotentials.iter().map(|(species, one)| one.copy(*species)).collect();
    text += &format!("pp_dirpath \"{DATA_DIRECTORY}\"\npseudos \"{}\"\n", copies.join(", "));
    let originals = pseudopotentials.values().map(|one| one.pinned.clone());
    Ok(CalculationInput {
        files: [(NAME.to_owned(), text.into_bytes())].into(),
        command: abinit.settings.command.iter().cloned().chain([NAME.to_owned()]).collect(),
        environment: abinit.environment.clone(),
        data: copies.into_iter().zip(originals).collect(),
    })
}

/// Keywords that do not depend on the structure: PBE, forces and stress, no symmetry but time reversal, no
/// files beside the output.
fn fixed(settings: &AbinitSettings) -> String {
    let occupation = match settings.smearing {
        Smearing::FermiDirac => 3,
        Smearing::MethfesselPaxton => 6,
        Smearing::Gaussian => 7,
    };
    format!(
        "ixc 11\necut {:?} eV\noccopt {occupation}\ntsmear {:?} eV\ntoldfe {:?} eV\nnsym 1\nkptopt 2\nchkprim 0\n\
         chksymbreak 0\noptforces 1\noptstress 1\nprtwf 0\nprtden 0\nprteig 0\nprtebands 0\nprtgsr 0\n",
        settings.cutoff, settings.smearing_width, settings.energy_tolerance
    )
}

fn electrons(
    text: &mut String,
    settings: &AbinitSettings,
    padded: &PaddedStructure,
    pseudopotentials: &BTreeMap<Species, &Pseudopotential>,
    adjustments: &BTreeSet<RetryAdjustment>,
) {
    let structure = &padded.structure;
    let electrons: f64 =
        structure.species.iter().filter_map(|s| pseudopotentials.get(s)).map(|p| p.valence).sum();
    let table = settings.spin_polarized.then_some(&settings.initial_magnetic_moments);
    let bands = moments::bands(structure, table, electrons);
    *text += &format!("nband {bands}\n");
    if pseudopotentials.values().any(|p| p.paw) {
        *text += &format!("pawecutdg {:?} eV\n", settings.fine_cutoff.unwrap_or(2.0 * settings.cutoff));
    }
    if settings.spin_polarized {
        *text += "nsppol 2\nspinat\n";
        for moment in moments::initial(structure, &settings.initial_magnetic_moments, adjustments) {
            *text += &format!("  0 0 {moment:?}\n");
        }
    }
    let [x, y, z] = padded.mesh(settings.k_spacing);
    *text += &format!("ngkpt {x} {y} {z}\nnshiftk 1\nshiftk 0 0 0\n");
}

fn steps(text: &mut String, settings: &AbinitSettings, paw: bool, adjustments: &BTreeSet<RetryAdjustment>) {
    let factor = if adjustments.contains(&RetryAdjustment::MoreSteps) { 3 } else { 1 };
    *text += &format!("nstep {}\n", settings.max_scf_steps.saturating_mul(factor));
    if adjustments.contains(&RetryAdjustment::SlowerMixing) {
        *text += "diemix 0.25\nnpulayit 15\n";
    }
    if adjustments.contains(&RetryAdjustment::OtherAlgorithm) {
        // 7 mixes potentials, 17 densities; each is the default of the other kind of pseudopotential.
        *text += &format!("iscf {}\nnline 8\nnnsclo 2\n", if paw { 7 } else { 17 });
    }
}

fn structure(
    text: &mut String,
    padded: &PaddedStructure,
    pseudopotentials: &BTreeMap<Species, &Pseudopotential>,
) {
    let structure = &padded.structure;
    let numbers: Vec<_> =
        pseudopotentials.keys().map(|species| species.atomic_number().to_string()).collect();
    *text +=
        &format!("natom {}\nntypat {}\nznucl {}\ntypat\n", structure.len(), numbers.len(), numbers.join(" "));
    // ABINIT truncates long lines.
    for atoms in structure.species.chunks(20) {
        for species in atoms {
            let kind = pseudopotentials.keys().position(|other| other == species).unwrap_or_default() + 1;
            *text += &format!(" {kind}");
        }
        *text += "\n";
    }
    *text += "acell 1 1 1 Angstrom\nrprim\n";
    structure.cell.0.iter().for_each(|row| vector(text, *row));
    *text += "xcart\n";
    structure.positions.iter().for_each(|position| vector(text, *position));
    *text += "  Angstrom\n";
}

/// Writes a vector with all digits.
fn vector(text: &mut String, [x, y, z]: Vec3) {
    // Writing to a string cannot fail.
    let _ = writeln!(text, "  {x:?} {y:?} {z:?}");
}
