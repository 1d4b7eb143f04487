//! Files of baselines (`.npz`): baselines of one model, with what ties them to it.

use std::io::{self, Read, Seek, Write};
use std::path::Path;

use npz::{Error, NpzFile, Writer};

use super::settings::BaselineSettings;
use super::{Baseline, BaselineKind, FeatureOrigin, stored};

/// Version of the layout.
const SCHEMA: usize = 1;

/// Baselines of one model.
#[derive(Debug, Clone, PartialEq)]
pub struct BaselineFile {
    /// The features that they belong to.
    pub origin: FeatureOrigin,
    /// How they were built.
    pub settings: BaselineSettings,
    /// In the order in which they were asked for.
    pub baselines: Vec<Baseline>,
}

impl BaselineFile {
    /// Writes the file. The same baselines give the same bytes.
    ///
    /// # Errors
    /// If writing fails.
    pub fn write<W: Write + Seek>(&self, out: W) -> io::Result<W> {
        let mut file = Writer::new(out);
        let names: Vec<&str> = self.origin.symbols.iter().map(String::as_str).collect();
        file.scalar("baseline_schema", SCHEMA as i64)?;
        file.strings("element_names", &[names.len()], &names)?;
        file.strings("feature_variant", &[], &[&self.origin.variant])?;
        file.scalar("feature_dimension", self.origin.dimension as i64)?;
        file.strings("model_hash", &[], &[&self.origin.model])?;
        let kinds: Vec<&str> = self.baselines.iter().map(|baseline| baseline.kind().name()).collect();
        file.strings("kinds", &[kinds.len()], &kinds)?;
        stored::write_settings(&mut file, &self.settings)?;
        for (number, baseline) in self.baselines.iter().enumerate() {
            stored::write(&mut file, number, baseline)?;
        }
        file.finish()
    }

    /// Reads a file.
    ///
    /// # Errors
    /// Missing or ill-shaped arrays, with file, key, what was found and what was expected.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, Error> {
        Self::read(&NpzFile::open(path.as_ref())?)
    }

    /// Reads an open archive.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read<R: Read + Seek>(file: &NpzFile<R>) -> Result<Self, Error> {
        if !file.contains("baseline_schema") {
            return Err(file.invalid(
                "baseline_schema",
                "no such array",
                "a file that `calmwalk calm baseline` wrote",
            ));
        }
        file.expect_count("baseline_schema", SCHEMA)?;
        let text = |key: &str| file.strings(key).map(|texts| texts.concat());
        let origin = FeatureOrigin {
            model: text("model_hash")?,
            variant: text("feature_variant")?,
            symbols: file.strings("element_names")?,
            dimension: file.count("feature_dimension", 1, 1 << 16)?,
        };
        if origin.symbols.is_empty() {
            return Err(file.invalid("element_names", "no element", "at least one"));
        }
        let settings = stored::read_settings(file)?;
        let mut baselines = Vec::new();
        for (number, name) in file.strings("kinds")?.into_iter().enumerate() {
            let kind = BaselineKind::named(&name);
            let kind =
                kind.ok_or_else(|| file.invalid("kinds", format!("'{name}'"), BaselineKind::names()))?;
            baselines.push(stored::read(file, number, kind, &origin)?);
        }
        if baselines.is_empty() {
            return Err(file.invalid("kinds", "no baseline", "at least one"));
        }
        Ok(Self { origin, settings, baselines })
    }
}
