//! Reads the label that a command wrote.

use std::path::Path;

use atoms::Structure;
use atoms::extxyz::{ExtxyzReader, Frame};

use crate::structure_check::check_same_structure;
use crate::{CalculationResults, Failure, FailureClass, result_file};

/// The precision of the digits that ASE writes.
const TOLERANCE: f64 = 1e-6;

/// The results in the file, if it is complete and describes this structure.
pub(super) fn label(structure: &Structure, path: &Path) -> Result<CalculationResults, Failure> {
    let frame = whole_frame(path).map_err(|fault| {
        let name = path.file_name().unwrap_or_default().display();
        FailureClass::Crashed.with_message(format!("the command ended with 0, but {name} {fault}"))
    })?;
    check_same_structure(structure, &frame.structure, TOLERANCE)?;
    numbers(frame).map_err(|message| FailureClass::Implausible.with_message(message))
}

/// The only frame of a file, or what is wrong with it.
fn whole_frame(path: &Path) -> Result<Frame, String> {
    let text = result_file::read(path).map_err(|error| error.to_string())?;
    // Without a line break at the end, the last number may be truncated.
    if text.last() != Some(&b'\n') {
        return Err("does not end with a line break: it is incomplete".to_owned());
    }
    let mut frames = ExtxyzReader::new(text.as_slice());
    let frame = frames.next().ok_or("is empty")?.map_err(|error| error.to_string())?;
    match frames.next() {
        None => Ok(frame),
        Some(_) => Err("has more than one frame".to_owned()),
    }
}

fn numbers(mut frame: Frame) -> Result<CalculationResults, String> {
    // Keys with this prefix would take precedence over the plain ones.
    frame.info.retain(|key, _| !key.starts_with("REF_"));
    frame.arrays.retain(|key, _| !key.starts_with("REF_"));
    let labels = frame.labels().map_err(|error| error.to_string())?;
    let energy = labels.energy.ok_or("the label has no energy")?;
    let forces = labels.forces.ok_or("the label has no forces")?;
    let free = match frame.info.get("free_energy") {
        None => None,
        Some(value) => {
            Some(value.number().filter(|x| x.is_finite()).ok_or("free_energy is not a finite number")?)
        }
    };
    let magnetic_moments = match frame.arrays.get("magmoms") {
        None => None,
        Some(column) => {
            let moments = column.reals().filter(|_| column.width == 1);
            let finite = moments.filter(|moments| moments.iter().all(|moment| moment.is_finite()));
            Some(finite.ok_or("magmoms are not a finite number for each atom")?)
        }
    };
    let extended = frame.structure.periodic != [false; 3];
    Ok(CalculationResults {
        energy: free.unwrap_or(energy),
        energy_without_smearing: free.map(|_| energy),
        forces,
        stress: labels.stress.filter(|_| extended),
        magnetisation: magnetic_moments.as_ref().map(|moments: &Vec<f64>| moments.iter().sum()),
        magnetic_moments,
        electronic_steps: None,
    })
}
