//! `calmwalk label-file`

use std::io::{self, Write};
use std::path::PathBuf;

use atoms::cell::{Matrix3, Vec3, norm};
use atoms::extxyz::{Column, ColumnData, Frame, FrameLabels, LabelKeys, write_frame};
use atoms::{Structure, read_structures};
use serde::Serialize;
use store::Protocol;
use tokio_util::sync::CancellationToken;
use workers::labeller::{SingleLabel, label_structure};

use super::{CommandError, ExitStatus, block_on};
use crate::atomic_file::{AtomicFile, cannot_write};
use crate::config::Config;
use crate::label_method::{self, MethodConfig};
use crate::log::LogArgs;
use crate::output::{print, print_json};
use crate::signals::cancel_on_signal;

/// Label the structures of a file, to test a label protocol without a campaign
///
/// Computes energy, forces and stress of one structure after the other, as the [label] section of --config says, and prints them with the
/// cost. Stops at the first failure. Pass the printed core-seconds to `calmwalk estimate --core-seconds` to estimate the cost of a
/// campaign.
#[derive(Debug, clap::Args)]
pub struct LabelFileArgs {
    /// Structures to label: extended XYZ or POSCAR
    #[arg(value_name = "STRUCTURES")]
    structures: PathBuf,
    /// Configuration; only its [label] section is used
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Also write the labelled structures to this file, extended XYZ; an existing file is replaced [default: print only]
    #[arg(long, short, value_name = "FILE.extxyz")]
    output: Option<PathBuf>,
    /// Print JSON, one object per structure
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    log: LogArgs,
}

/// A labelled structure, as it is printed.
#[derive(Serialize)]
struct Labelled {
    /// `file:line`
    #[serde(rename = "place")]
    source: String,
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

impl LabelFileArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        self.log.init("label-file")?;
        block_on(async {
            let stop = CancellationToken::new();
            cancel_on_signal(stop.clone(), "stopping …")?;
            self.label(&stop).await
        })?
    }

    /// Labels the structures one after the other, up to the first failure.
    async fn label(&self, stop: &CancellationToken) -> Result<ExitStatus, CommandError> {
        let section = Config::load_label(&self.config)?;
        let frames = read_structures(&self.structures).map_err(CommandError::input)?;
        let setup = MethodConfig::from_section(&section)?;
        let protocol = label_method::protocol(section.protocol_name(), setup.identity()?);
        let method = setup.load(&protocol)?;
        let bounds = section.bounds();
        let mut output = self.output.as_deref().map(AtomicFile::create).transpose()?;
        for frame in frames {
            let source = format!("{}:{}", self.structures.display(), frame.line);
            let structure = frame.structure;
            structure.validate().map_err(|error| CommandError::Input(format!("{source}: {error}")))?;
            let attempt = tokio::select! {
                attempt = label_structure(&method, &structure, &bounds) => attempt?,
                () = stop.cancelled() => {
                    method.stop().await?;
                    return Ok(ExitStatus::Interrupted);
                }
            };
            let labelled = Labelled::new(source, &structure, &protocol, attempt)?;
            if self.json {
                print_json(&labelled)?;
            } else {
                print(|out| labelled.write(out))?;
            }
            if let (Some(file), Some(path)) = (&mut output, &self.output) {
                write_frame(file, &labelled.frame(structure)).map_err(|error| cannot_write(path, error))?;
            }
        }
        output.map_or(Ok(()), AtomicFile::finish)?;
        Ok(ExitStatus::Done)
    }
}

impl Labelled {
    fn new(
        source: String,
        structure: &Structure,
        protocol: &Protocol,
        attempt: SingleLabel,
    ) -> Result<Self, CommandError> {
        let SingleLabel { result, log, core_seconds } = attempt;
        let label = result.map_err(|failure| {
            let log = log.trim_end();
            let log = if log.is_empty() { String::new() } else { format!("; end of its log:\n{log}") };
            CommandError::Failed(format!("{source}: no label: {failure}{log}"))
        })?;
        Ok(Self {
            source,
            formula: structure.formula(),
            atoms: structure.len(),
            protocol: protocol.name.clone(),
            protocol_hash: protocol.hash.to_string(),
            energy: label.energy,
            energy_without_smearing: label.energy_without_smearing,
            forces: label.forces,
            stress: label.stress,
            magnetic_moments: label.magnetic_moments,
            magnetisation: label.magnetisation,
            electronic_steps: label.electronic_steps,
            core_seconds,
        })
    }

    fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        writeln!(out, "{}: {}, {} atoms", self.source, self.formula, self.atoms)?;
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
        frame.set_labels(&FrameLabels { energy, forces, stress: self.stress }, LabelKeys::Ase);
        frame.info.insert("protocol".to_owned(), self.protocol.clone().into());
        frame.info.insert("protocol_hash".to_owned(), self.protocol_hash[..16].to_owned().into());
        if let Some(moments) = &self.magnetic_moments {
            let column = Column { width: 1, entries: ColumnData::Real(moments.clone()) };
            frame.arrays.insert("magmoms".to_owned(), column);
        }
        frame
    }
}
