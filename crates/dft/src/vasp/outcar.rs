//! Reads `OUTCAR`: data that only this file has, and everything needed if `vasprun.xml` is truncated.

use std::io::BufRead;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Cell, Species, Structure};

use super::fixed_width::numbers;
use super::output::{self, Output};

/// Positions have five decimals.
const RESOLUTION: f64 = 1e-4;

/// The content of a complete or truncated file; of the last ionic step if the atoms moved.
#[derive(Debug, Default)]
pub(super) struct Outcar {
    version: Option<String>,
    /// Elements in the order of POTCAR.
    elements: Vec<Option<Species>>,
    /// The elements from the lines `POTCAR:`, for files without `TITEL`. The list may have further entries.
    listed: Vec<Option<Species>>,
    /// Number of atoms of each element.
    counts: Vec<usize>,
    most_steps: Option<u32>,
    ionic_steps: u32,
    steps: u32,
    /// Whether the last electronic step met the tolerance.
    converged: bool,
    energy: Option<f64>,
    energy_without_smearing: Option<f64>,
    cell: Vec<Vec3>,
    /// Position, Å, and force, eV/Å, of each atom.
    atoms: Vec<[f64; 6]>,
    /// xx, yy, zz, xy, yz, zx, kB, positive for compression.
    stress: Option<[f64; 6]>,
    /// Magnetic moment of each atom, in the order of POSCAR, μ_B.
    pub moments: Vec<f64>,
    /// Magnetic moment of the cell, μ_B.
    pub magnetisation: Option<f64>,
    complete: bool,
}

/// The table to which the next lines belong.
#[derive(Clone, Copy, PartialEq)]
enum OutcarTable {
    None,
    Cell,
    Atoms { begun: bool },
    Moments { begun: bool },
}

impl Outcar {
    /// Reads what is there and ignores what cannot be read.
    pub fn read(mut input: impl BufRead) -> Self {
        let mut outcar = Self::default();
        let (mut table, mut bytes) = (OutcarTable::None, Vec::new());
        loop {
            bytes.clear();
            match input.read_until(b'\n', &mut bytes) {
                // A truncated line may end within a number.
                Ok(_) if bytes.last() == Some(&b'\n') => {}
                _ => return outcar,
            }
            let line = String::from_utf8_lossy(&bytes);
            table = match table {
                OutcarTable::None => outcar.line(&line),
                table => outcar.row(&line, table),
            };
        }
    }

    /// Reads a line outside tables; returns the table that starts after it.
    fn line(&mut self, line: &str) -> OutcarTable {
        let after = |mark: &str| line.split_once(mark).map(|(_, rest)| rest.trim_start());
        if self.version.is_none()
            && let Some(rest) = after("vasp.")
        {
            self.version = rest.split_whitespace().next().map(str::to_owned);
        } else if let Some(title) = after("TITEL  =") {
            self.elements.push(element(title));
        } else if let Some(title) = after("POTCAR:") {
            self.listed.push(element(title));
        } else if let Some(rest) = after("ions per type =") {
            self.counts = rest.split_whitespace().map_while(|word| word.parse().ok()).collect();
        } else if self.most_steps.is_none()
            && let Some(rest) = after("NELM   =")
        {
            self.most_steps = rest.split(';').next().and_then(|word| word.trim().parse().ok());
        } else if let Some(rest) = after("- Iteration") {
            self.step(rest);
        } else if line.contains("aborting loop because EDIFF is reached") {
            self.converged = true;
        } else if let Some(rest) = after("free  energy   TOTEN  =") {
            self.energy = rest.trim_end().strip_suffix("eV").and_then(number);
        } else if line.contains("energy  without entropy=") {
            self.energy_without_smearing = after("energy(sigma->0) =").and_then(number);
        } else if let Some(rest) = line.trim_start().strip_prefix("in kB") {
            self.stress = numbers(rest, 5).and_then(|stress| stress.try_into().ok());
        } else if let Some(rest) =
            after("number of electron").and_then(|rest| rest.split_once("magnetization"))
        {
            self.magnetisation = number(rest.1);
        } else if line.contains("direct lattice vectors") {
            self.cell.clear();
            return OutcarTable::Cell;
        } else if line.contains("POSITION") && line.contains("TOTAL-FORCE") {
            self.atoms.clear();
            return OutcarTable::Atoms { begun: false };
        } else if line.trim() == "magnetization (x)" {
            self.moments.clear();
            return OutcarTable::Moments { begun: false };
        } else if line.contains("General timing and accounting informations") {
            self.complete = true;
        }
        OutcarTable::None
    }

    /// `   1(  13)  -----`: the start of an electronic step.
    fn step(&mut self, numbers: &str) {
        let ionic =
            numbers.split('(').next().and_then(|word| word.trim().parse().ok()).unwrap_or(self.ionic_steps);
        if ionic != self.ionic_steps {
            (self.ionic_steps, self.steps) = (ionic, 0);
        }
        self.steps += 1;
        self.converged = false;
    }

    /// Reads a line in a table; returns the table of the next line.
    fn row(&mut self, line: &str, table: OutcarTable) -> OutcarTable {
        let ruled = line.trim_start().starts_with("-----");
        match table {
            OutcarTable::Cell => match numbers(line, 9).as_deref() {
                Some(&[x, y, z, ..]) => {
                    self.cell.push([x, y, z]);
                    if self.cell.len() < 3 { table } else { OutcarTable::None }
                }
                _ => OutcarTable::None,
            },
            OutcarTable::Atoms { begun: false } if ruled => OutcarTable::Atoms { begun: true },
            OutcarTable::Moments { begun: false } if ruled => OutcarTable::Moments { begun: true },
            OutcarTable::Atoms { begun: false } | OutcarTable::Moments { begun: false } => table,
            OutcarTable::Atoms { .. } => match numbers(line, 6).and_then(|row| row.try_into().ok()) {
                Some(row) => {
                    self.atoms.push(row);
                    table
                }
                None => OutcarTable::None,
            },
            OutcarTable::Moments { .. } => match numbers(line, 3).as_deref() {
                Some(&[_, .., total]) => {
                    self.moments.push(total);
                    table
                }
                _ => OutcarTable::None,
            },
            OutcarTable::None => OutcarTable::None,
        }
    }

    /// Whether the file is complete and does not state that the electrons converged.
    pub fn denies_convergence(&self) -> bool {
        self.complete && !self.converged
    }

    /// The output of a calculation that ran to its end, converged or not.
    ///
    /// # Errors
    /// A message that names what is missing.
    pub fn output(self) -> Result<Output, String> {
        if !self.complete {
            return Err("ends before its timings".to_owned());
        }
        let species = self.species()?;
        let most_steps = self.most_steps.ok_or("has no NELM")?;
        let energy = self.energy.ok_or("has no energy")?;
        let cell = Matrix3::try_from(self.cell).map_err(|_| "has no cell")?;
        let positions = self.atoms.iter().map(|[x, y, z, ..]| [*x, *y, *z]).collect();
        let kilobar = self.stress.map(|[xx, yy, zz, xy, yz, zx]| [[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]]);
        Ok(Output {
            version: self.version.unwrap_or_default(),
            structure: Structure { species, positions, cell: Cell(cell), periodic: [true; 3] },
            resolution: RESOLUTION,
            ionic_steps: self.ionic_steps,
            most_steps,
            // The program stops at this limit whether it has converged or not.
            steps: if self.converged { self.steps } else { self.steps.max(most_steps) },
            energy,
            energy_without_smearing: self.energy_without_smearing.ok_or("has no energy without smearing")?,
            forces: self.atoms.iter().map(|[_, _, _, x, y, z]| [*x, *y, *z]).collect(),
            stress: kilobar.map(|kilobar| output::stress(&kilobar)),
        })
    }

    /// The element of each atom.
    fn species(&self) -> Result<Vec<Species>, String> {
        let elements = if self.elements.is_empty() { &self.listed } else { &self.elements };
        if elements.len() < self.counts.len() {
            let (elements, counts) = (elements.len(), self.counts.len());
            return Err(format!("has {elements} titles of POTCAR for {counts} numbers of ions"));
        }
        let mut species = Vec::new();
        for (element, count) in elements.iter().zip(&self.counts) {
            let element = element.ok_or("has a title of POTCAR without an element")?;
            // More than the number of atoms is wrong in any case and could exhaust the memory.
            species.extend(std::iter::repeat_n(element, (*count).min(self.atoms.len() + 1)));
        }
        Ok(species)
    }
}

/// The element in a title: `PAW_PBE Fe_pv 06Sep2000`.
fn element(title: &str) -> Option<Species> {
    output::element(title.split_whitespace().nth(1)?.split(['_', '.']).next()?)
}

fn number(text: &str) -> Option<f64> {
    numbers(text, 8)?.first().copied()
}
