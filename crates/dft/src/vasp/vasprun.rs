//! Reads `vasprun.xml`.

use std::io::BufRead;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Cell, Species, Structure};
use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::fixed_width::{numbers, vector};
use super::output::{self, Output};

/// Decimals of lengths, forces and stresses.
const DECIMALS: usize = 8;

/// Precision of fractional coordinates with eight decimals, in a cell of 100 Å.
const RESOLUTION: f64 = 1e-5;

/// Long sections that are not needed.
const SKIPPED: [&str; 5] = ["eigenvalues", "dos", "projected", "kpoints", "symmetry"];

/// Reads a complete file.
///
/// # Errors
/// A message that names what is missing or damaged.
pub(super) fn read(input: impl BufRead) -> Result<Output, String> {
    let mut reader = Reader::from_reader(input);
    let mut file = VasprunParser::default();
    let (mut buffer, mut skipped) = (Vec::new(), Vec::new());
    while !file.complete {
        buffer.clear();
        match reader.read_event_into(&mut buffer).map_err(|error| error.to_string())? {
            Event::Start(tag) if SKIPPED.contains(&tag.name().as_ref()) => {
                skipped.clear();
                reader.read_to_end_into(tag.name(), &mut skipped).map_err(|error| error.to_string())?;
            }
            Event::Start(tag) => file.open(&tag)?,
            Event::Text(text) => file.text.push_str(&text),
            Event::End(_) => file.close()?,
            Event::Eof => return Err("ends before </modeling>".to_owned()),
            _ => {}
        }
    }
    file.output()
}

/// The state of the parser.
#[derive(Default)]
struct VasprunParser {
    /// The attribute `name`, or else the tag, of each open element.
    path: Vec<String>,
    /// Text of the innermost element.
    text: String,
    complete: bool,
    version: String,
    most_steps: Option<u32>,
    species: Vec<Species>,
    /// Entries in the open table row.
    row: usize,
    ionic_steps: u32,
    last: IonicStep,
}

/// The content of `<calculation>`.
#[derive(Default)]
struct IonicStep {
    steps: u32,
    /// Free energy of the last electronic step and its extrapolation to zero smearing, eV.
    step_energies: [Option<f64>; 2],
    /// Free energy, eV.
    energy: Option<f64>,
    cell: Vec<Vec3>,
    /// Fractional.
    positions: Vec<Vec3>,
    forces: Vec<Vec3>,
    stress: Vec<Vec3>,
}

impl VasprunParser {
    fn open(&mut self, tag: &BytesStart) -> Result<(), String> {
        self.text.clear();
        let name = tag.try_get_attribute("name").map_err(|error| error.to_string())?;
        let name = match &name {
            Some(name) => name.value.as_ref(),
            None => tag.name().into_inner(),
        };
        self.path.push(name.to_owned());
        match tag.name().as_ref() {
            "calculation" => {
                self.ionic_steps += 1;
                self.last = IonicStep::default();
            }
            "scstep" => self.last.steps += 1,
            "rc" => self.row = 0,
            _ => {}
        }
        Ok(())
    }

    fn close(&mut self) -> Result<(), String> {
        let path: Vec<&str> = self.path.iter().map(String::as_str).collect();
        let text = self.text.trim();
        let wrong = || format!("has '{text}' in {}", path.join("/"));
        match path.as_slice() {
            ["modeling", "calculation", path @ ..] => self.last.take(path, text).ok_or_else(wrong)?,
            ["modeling", "generator", "version"] => text.clone_into(&mut self.version),
            // NELM appears several times; only the first belongs to the calculation.
            [.., "NELM"] if self.most_steps.is_none() => {
                self.most_steps = Some(text.parse().map_err(|_| wrong())?);
            }
            ["modeling", "atominfo", "atoms", "set", "rc", "c"] => {
                if self.row == 0 {
                    self.species.push(output::element(text).ok_or_else(wrong)?);
                }
                self.row += 1;
            }
            ["modeling"] => self.complete = true,
            _ => {}
        }
        self.text.clear();
        self.path.pop();
        Ok(())
    }

    fn output(self) -> Result<Output, String> {
        let last = self.last;
        let matrix = |rows: Vec<Vec3>| Matrix3::try_from(rows).ok();
        let energy = last.energy.ok_or("has no energy")?;
        let cell = Cell(matrix(last.cell).ok_or("has no cell")?);
        let positions = last.positions.iter().map(|fractional| cell.cartesian(*fractional)).collect();
        // In files of some versions the final value is 0; that of the last electronic step is right.
        let [free, without_smearing] = last.step_energies;
        let correction = free.zip(without_smearing).map(|(free, without)| without - free);
        Ok(Output {
            version: self.version,
            structure: Structure { species: self.species, positions, cell, periodic: [true; 3] },
            resolution: RESOLUTION,
            ionic_steps: self.ionic_steps,
            most_steps: self.most_steps.ok_or("has no NELM")?,
            steps: last.steps,
            energy,
            energy_without_smearing: energy + correction.ok_or("has no electronic steps with energies")?,
            forces: last.forces,
            stress: matrix(last.stress).map(|kilobar| output::stress(&kilobar)),
        })
    }
}

impl IonicStep {
    /// Stores the text of an element if it is needed; `None` if it is invalid.
    fn take(&mut self, path: &[&str], text: &str) -> Option<()> {
        match path {
            ["structure", "crystal", "basis", "v"] => self.cell.push(vector(text, DECIMALS)?),
            ["structure", "positions", "v"] => self.positions.push(vector(text, DECIMALS)?),
            ["forces", "v"] => self.forces.push(vector(text, DECIMALS)?),
            ["stress", "v"] => self.stress.push(vector(text, DECIMALS)?),
            ["scstep", "energy", "e_fr_energy"] => self.step_energies[0] = Some(number(text)?),
            ["scstep", "energy", "e_0_energy"] => self.step_energies[1] = Some(number(text)?),
            ["energy", "e_fr_energy"] => self.energy = Some(number(text)?),
            _ => {}
        }
        Some(())
    }
}

fn number(text: &str) -> Option<f64> {
    numbers(text, DECIMALS)?.try_into().ok().map(|[number]: [f64; 1]| number)
}
