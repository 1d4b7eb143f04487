//! Writes the input of the script.

use std::collections::{BTreeMap, BTreeSet};

use atoms::Species;
use atoms::cell::{Matrix3, Vec3};
use serde::Serialize;
use serde_json::{Value, json};

use super::{Gpaw, GpawSettings, SCRIPT, setups};
use crate::moments;
use crate::padded_structure::PaddedStructure;
use crate::pinned_file::DATA_DIRECTORY;
use crate::{CalculationInput, Failure, FailureClass, RetryAdjustment, Smearing};

/// Name of the script in the directory of a calculation.
pub(super) const SCRIPT_FILE: &str = "job.py";

/// `input.json`
#[derive(Serialize)]
struct Task<'a> {
    species: &'a [Species],
    positions: &'a [Vec3],
    cell: &'a Matrix3,
    moments: Option<Vec<f64>>,
    /// Directory of the setups.
    setups: &'a str,
    cutoff: f64,
    /// Keyword arguments of `GPAW`.
    parameters: Value,
}

pub(super) fn write(
    gpaw: &Gpaw,
    padded: &PaddedStructure,
    adjustments: &BTreeSet<RetryAdjustment>,
) -> Result<CalculationInput, Failure> {
    let (settings, structure) = (&gpaw.settings, &padded.structure);
    let mut data = BTreeMap::new();
    for species in BTreeSet::from_iter(structure.species.iter().copied()) {
        let setup =
            gpaw.setup(species).map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
        data.insert(setups::name(species, &settings.pseudopotential_variants), setup.pinned.clone());
    }
    let task = Task {
        species: &structure.species,
        positions: &structure.positions,
        cell: &structure.cell.0,
        moments: settings
            .spin_polarized
            .then(|| moments::initial(structure, &settings.initial_magnetic_moments, adjustments)),
        setups: DATA_DIRECTORY,
        cutoff: settings.cutoff,
        parameters: parameters(
            settings,
            padded.mesh(settings.k_spacing),
            gpaw.electrons(structure),
            adjustments,
        ),
    };
    let task = serde_json::to_vec_pretty(&task)
        .map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
    Ok(CalculationInput {
        files: [(SCRIPT_FILE.to_owned(), SCRIPT.into()), ("input.json".to_owned(), task)].into(),
        command: settings.command.iter().cloned().chain([SCRIPT_FILE.to_owned()]).collect(),
        environment: gpaw.environment.clone(),
        data,
    })
}

fn parameters(
    settings: &GpawSettings,
    mesh: [u32; 3],
    electrons: f64,
    adjustments: &BTreeSet<RetryAdjustment>,
) -> Value {
    let mut parameters = json!({
        "xc": "PBE",
        "setups": settings.pseudopotential_variants,
        "kpts": { "size": mesh, "gamma": true },
        "symmetry": { "point_group": false },
        "spinpol": settings.spin_polarized,
        "occupations": occupations(settings.smearing, settings.smearing_width),
        // GPAW's criterion is per valence electron.
        "convergence": {
            "energy": settings.energy_tolerance / electrons.max(1.0),
            "forces": settings.force_tolerance,
        },
        "maxiter": settings.max_scf_steps,
    });
    if adjustments.contains(&RetryAdjustment::MoreSteps) {
        parameters["maxiter"] = json!(settings.max_scf_steps.saturating_mul(3));
    }
    if adjustments.contains(&RetryAdjustment::SlowerMixing) {
        parameters["mixer"] = json!({ "beta": 0.02, "nmaxold": 8, "weight": 100.0 });
    }
    if adjustments.contains(&RetryAdjustment::OtherAlgorithm) {
        parameters["eigensolver"] = json!({ "name": "cg" });
    }
    parameters
}

fn occupations(smearing: Smearing, width: f64) -> Value {
    match smearing {
        // Methfessel–Paxton of order 0 is the Gaussian.
        Smearing::Gaussian => json!({ "name": "methfessel-paxton", "order": 0, "width": width }),
        Smearing::MethfesselPaxton => json!({ "name": "methfessel-paxton", "order": 1, "width": width }),
        Smearing::FermiDirac => json!({ "name": "fermi-dirac", "width": width }),
    }
}
