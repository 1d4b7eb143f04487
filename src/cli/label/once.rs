//! `calmwalk label --once`: tries a method and its settings out.

use std::io::{self, Write};
use std::path::Path;

use atoms::cell::{Matrix3, Vec3, norm};
use atoms::extxyz::{Column, Entries, Frame, Keys, Labels, write_frame};
use atoms::{Structure, read_structures};
use serde::Serialize;
use store::Protocol;
use tokio::sync::Notify;
use workers::labeller::{SingleLabel, label_structure};

use super::{Ended, Failure};
use crate::config::Config;
use crate::labelling;
use crate::output::{print, print_json};
use crate::setup::MethodSetup;
use crate::whole_file::{WholeFile, cannot_write};

/// What is to be labelled, how, and what becomes of it.
pub struct Task<'a> {
    /// Extended XYZ or POSCAR.
    pub structures: &'a Path,
    /// The configuration whose `[label]` section counts.
    pub config: &'a Path,
    /// Where the labelled structures go.
    pub output: Option<&'a Path>,
    /// As JSON.
    pub json: bool,
}

/// A labelled structure, as it is printed.
#[derive(Serialize)]
struct Labelled {
    /// `file:line`
    place: String,
    formula: String,
    atoms: usize,
    protocol: String,
    protocol_hash: String,
    /// eV
    energy: f64,
    /// eV
    energy_without_smearing: Option<f64>,
    /// eV/Å
    forces: Vec<Vec3>,
    /// eV/Å³, tension positive
    stress: Option<Matrix3>,
    /// μ_B
    magnetic_moments: Option<Vec<f64>>,
    /// μ_B
    magnetisation: Option<f64>,
    electronic_steps: Option<u32>,
    core_seconds: f64,
}

/// Labels each structure of the file, one after the other. The first failure ends it.
pub async fn label(task: Task<'_>, stop: &Notify) -> Result<Ended, Failure> {
    let section = Config::load_label(task.config)?;
    let frames = read_structures(task.structures).map_err(Failure::input)?;
    let setup = MethodSetup::of(&section)?;
    let protocol = labelling::protocol(section.protocol_name(), setup.identity()?);
    let method = setup.load(&protocol)?;
    let bounds = section.bounds();
    let mut output = task.output.map(WholeFile::create).transpose()?;
    for frame in frames {
        let place = format!("{}:{}", task.structures.display(), frame.line);
        let structure = frame.structure;
        structure.validate().map_err(|error| Failure::Input(format!("{place}: {error}")))?;
        let once = tokio::select! {
            once = label_structure(&method, &structure, &bounds) => once?,
            () = stop.notified() => {
                method.stop().await?;
                return Ok(Ended::Interrupted);
            }
        };
        let labelled = Labelled::from(&place, &structure, &protocol, once)?;
        if task.json {
            print_json(&labelled)?;
        } else {
            print(|out| labelled.write(out))?;
        }
        if let (Some(file), Some(path)) = (&mut output, task.output) {
            write_frame(file, &labelled.frame(structure)).map_err(|error| cannot_write(path, error))?;
        }
    }
    output.map_or(Ok(()), WholeFile::finish)?;
    Ok(Ended::Done)
}

impl Labelled {
    fn from(
        place: &str,
        structure: &Structure,
        protocol: &Protocol,
        once: SingleLabel,
    ) -> Result<Self, Failure> {
        let SingleLabel { result, log, core_seconds } = once;
        let made = result.map_err(|failure| {
            let log = log.trim_end();
            let end = if log.is_empty() { String::new() } else { format!("; it said last\n{log}") };
            Failure::Failed(format!("{place}: no label: {failure}{end}"))
        })?;
        Ok(Self {
            place: place.to_owned(),
            formula: structure.formula(),
            atoms: structure.len(),
            protocol: protocol.name.clone(),
            protocol_hash: protocol.hash.to_string(),
            energy: made.energy,
            energy_without_smearing: made.energy_without_smearing,
            forces: made.forces,
            stress: made.stress,
            magnetic_moments: made.magnetic_moments,
            magnetisation: made.magnetisation,
            electronic_steps: made.electronic_steps,
            core_seconds,
        })
    }

    fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        writeln!(out, "{}: {}, {} atoms", self.place, self.formula, self.atoms)?;
        writeln!(out, "  protocol                '{}', {:.16}", self.protocol, self.protocol_hash)?;
        writeln!(out, "  energy                  {:.6} eV", self.energy)?;
        if let Some(energy) = self.energy_without_smearing {
            writeln!(out, "  without smearing        {energy:.6} eV")?;
        }
        let largest = self.forces.iter().map(|force| norm(*force)).fold(0.0, f64::max);
        writeln!(out, "  largest force           {largest:.4} eV/Å")?;
        if let Some(stress) = self.stress {
            let pressure = -(stress[0][0] + stress[1][1] + stress[2][2]) / 3.0;
            writeln!(out, "  pressure                {pressure:.6} eV/Å³")?;
        }
        if let Some(magnetisation) = self.magnetisation {
            writeln!(out, "  magnetic moment         {magnetisation:.3} μ_B")?;
        }
        if let Some(steps) = self.electronic_steps {
            writeln!(out, "  electronic steps        {steps}")?;
        }
        writeln!(out, "  cost                    {:.1} core-seconds", self.core_seconds)
    }

    fn frame(&self, structure: Structure) -> Frame {
        let mut frame = Frame::from(structure);
        let (energy, forces) = (Some(self.energy), Some(self.forces.clone()));
        frame.set_labels(&Labels { energy, forces, stress: self.stress }, Keys::Ase);
        frame.info.insert("protocol".to_owned(), self.protocol.clone().into());
        frame.info.insert("protocol_hash".to_owned(), self.protocol_hash[..16].to_owned().into());
        if let Some(moments) = &self.magnetic_moments {
            let column = Column { width: 1, entries: Entries::Real(moments.clone()) };
            frame.arrays.insert("magmoms".to_owned(), column);
        }
        frame
    }
}
