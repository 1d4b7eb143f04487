//! The arguments of a command that reads structures from files.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use atoms::Species;

use super::format::{check_format, check_format_or_extxyz};
use super::{StructureFile, StructureFiles};
use crate::exit_status::CommandError;
use crate::filter::StructureFilter;

/// Properties that structures of files have.
const PROPERTIES: [&str; 5] = ["atoms", "element", "energy", "energy_per_atom", "max_force"];

/// Where structures come from.
#[derive(Debug, Clone, clap::Args)]
pub struct StructureArgs {
    /// Structures: extended XYZ (.extxyz, .xyz), POSCAR (.poscar, .vasp, POSCAR*, CONTCAR*) or text dumps of LAMMPS (.dump,
    /// .lammpstrj, dump.*), each also with .gz or .zst
    #[arg(value_name = "DATA", required = true)]
    data: Vec<PathBuf>,
    #[command(flatten)]
    reading: StructureReadingArgs,
}

/// How files of structures are read.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct StructureReadingArgs {
    /// Use only structures that match FILTER, such as 'atoms < 200 and not element = Gd'; properties: atoms, element,
    /// and of labels energy, energy_per_atom (eV), max_force (eV/Å)
    #[arg(long = "where", value_name = "FILTER")]
    filter: Option<StructureFilter>,
    /// Elements of the atom types 1, 2, … of LAMMPS dumps without the column 'element'
    #[arg(long, value_name = "SYMBOL,…", value_delimiter = ',')]
    dump_elements: Vec<Species>,
}

impl StructureArgs {
    /// The files in the order given, all with weight 1.
    ///
    /// # Errors
    /// Those of [`StructureReadingArgs::files`].
    pub fn files(&self) -> Result<StructureFiles, CommandError> {
        self.reading.files(&self.data)
    }
}

impl StructureReadingArgs {
    /// A single file, which is read once: it may be a pipe. If its name shows no format, it is read as extended XYZ.
    ///
    /// # Errors
    /// A file of a format that cannot be read; a filter as in [`Self::files`].
    pub fn single_file(&self, path: &Path) -> Result<StructureFiles, CommandError> {
        self.check_filter()?;
        check_format_or_extxyz(path)?;
        let files = vec![StructureFile { path: path.into(), weight: 1.0 }];
        Ok(StructureFiles { files, filter: self.filter.clone(), dump_elements: self.dump_elements.clone() })
    }

    fn check_filter(&self) -> Result<(), CommandError> {
        if let Some(filter) = &self.filter
            && let Some(name) = filter.names().into_iter().find(|name| !PROPERTIES.contains(name))
        {
            return Err(CommandError::Input(format!(
                "--where: structures of files have no '{name}'; expected one of {}",
                PROPERTIES.join(", ")
            )));
        }
        Ok(())
    }

    /// These files in the order given, all with weight 1.
    ///
    /// # Errors
    /// A file that is no regular file, has an unknown format or is given twice; a filter by a property that structures of files do
    /// not have.
    pub fn files(&self, data: &[PathBuf]) -> Result<StructureFiles, CommandError> {
        self.check_filter()?;
        let (mut files, mut known) = (Vec::with_capacity(data.len()), HashSet::new());
        for path in data {
            check_format(path)?;
            let found = std::fs::metadata(path).map_err(|error| {
                CommandError::Unreadable(format!("{}: cannot be opened: {error}", path.display()))
            })?;
            if !found.is_file() {
                return Err(CommandError::Input(format!(
                    "{}: expected a regular file, which can be read several times",
                    path.display()
                )));
            }
            if !known.insert(path) {
                return Err(CommandError::Input(format!("{} is given twice", path.display())));
            }
            files.push(StructureFile { path: path.as_path().into(), weight: 1.0 });
        }
        Ok(StructureFiles { files, filter: self.filter.clone(), dump_elements: self.dump_elements.clone() })
    }
}
