//! Tables of POTCAR variants and initial magnetic moments by element.

use std::collections::BTreeSet;
use std::collections::btree_map::{BTreeMap, Entry};
use std::fmt;
use std::path::PathBuf;

use atoms::Species;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::VaspSettings;
use crate::SetupError;
use crate::moments::{DEFAULT_MOMENT, InitialMagneticMoments};

const MP_RELAX_SET: &str = include_str!("mp_relax_set.toml");

/// Where the POTCAR variant and the initial moment of each element come from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum ElementTable {
    /// The relaxation set of the Materials Project, as pymatgen 2026.10.16 has it.
    #[serde(rename = "MPRelaxSet")]
    MpRelaxSet,
    /// A TOML file with the tables `pseudopotential_variants` and `initial_magnetic_moments`, and with
    /// `default_magnetic_moment` for all other elements.
    #[serde(rename = "file")]
    File(PathBuf),
}

/// The content of a table.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entries {
    /// Moment of elements without an entry, μ_B.
    #[serde(default = "default_moment")]
    default_magnetic_moment: f64,
    #[serde(default)]
    initial_magnetic_moments: InitialMagneticMoments,
    pseudopotential_variants: BTreeMap<Species, String>,
}

fn default_moment() -> f64 {
    DEFAULT_MOMENT
}

impl ElementTable {
    /// Fills in the variant and the moment of each element that may occur, where the settings have none. The result
    /// has neither table nor elements: it is the same as if all entries had been written out.
    ///
    /// # Errors
    /// A file that cannot be read, or an element without a variant.
    pub(super) fn fill(&self, settings: &VaspSettings) -> Result<VaspSettings, SetupError> {
        let entries = self.read()?;
        let mut filled = VaspSettings { element_table: None, elements: Vec::new(), ..settings.clone() };
        let given = settings.pseudopotential_variants.keys().copied();
        let elements: BTreeSet<Species> = match settings.elements.is_empty() {
            true => given.chain(entries.pseudopotential_variants.keys().copied()).collect(),
            false => given.chain(settings.elements.iter().copied()).collect(),
        };
        filled.initial_magnetic_moments.retain(|species, _| elements.contains(species));
        for species in elements {
            if let Entry::Vacant(vacant) = filled.pseudopotential_variants.entry(species) {
                vacant.insert(self.variant(&entries, species)?);
            }
            let of_table = entries.initial_magnetic_moments.get(&species).copied();
            let moment = of_table.unwrap_or(entries.default_magnetic_moment);
            filled.initial_magnetic_moments.entry(species).or_insert(moment);
        }
        // What holds without an entry needs none.
        filled.initial_magnetic_moments.retain(|_, moment| *moment != DEFAULT_MOMENT);
        Ok(filled)
    }

    fn variant(&self, entries: &Entries, species: Species) -> Result<String, SetupError> {
        let reason = || format!("{self} has none; name one in `pseudopotential_variants`");
        let variant = entries.pseudopotential_variants.get(&species).cloned();
        variant.ok_or_else(|| SetupError::Pseudopotential { species, reason: reason() })
    }

    fn read(&self) -> Result<Entries, SetupError> {
        let wrong = |found: String| {
            SetupError::Setting {
            key: "element_table",
            found,
            expected: "a TOML file with the table [pseudopotential_variants] and, where needed, [initial_magnetic_moments] \
                       and default_magnetic_moment, by element"
                .to_owned(),
        }
        };
        let text = match self {
            Self::MpRelaxSet => MP_RELAX_SET.to_owned(),
            Self::File(path) => std::fs::read_to_string(path)
                .map_err(|error| wrong(format!("{}: {error}", path.display())))?,
        };
        let entries: Entries = toml::from_str(&text)
            .map_err(|error| wrong(format!("{self}: {}", error.to_string().trim_end())))?;
        let moments = entries.initial_magnetic_moments.values().chain([&entries.default_magnetic_moment]);
        let invalid = moments.copied().find(|moment| !moment.is_finite());
        match invalid {
            Some(moment) => Err(wrong(format!("{self} with a moment of {moment}"))),
            None => Ok(entries),
        }
    }
}

impl fmt::Display for ElementTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::MpRelaxSet => f.write_str("the table MPRelaxSet"),
            Self::File(path) => write!(f, "the table {}", path.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn species(symbols: &[&str]) -> Vec<Species> {
        symbols.iter().map(|symbol| symbol.parse().unwrap()).collect()
    }

    fn with_table(elements: &[&str]) -> VaspSettings {
        VaspSettings {
            element_table: Some(ElementTable::MpRelaxSet),
            elements: species(elements),
            ..VaspSettings::default()
        }
    }

    #[test]
    fn the_embedded_table_is_the_published_one() {
        let entries = ElementTable::MpRelaxSet.read().unwrap();
        assert_eq!(
            (entries.pseudopotential_variants.len(), entries.initial_magnetic_moments.len()),
            (89, 10)
        );
        let variant = |symbol: &str| entries.pseudopotential_variants[&symbol.parse().unwrap()].as_str();
        assert_eq!(["Fe", "W", "Yb", "O", "Li"].map(variant), ["Fe_pv", "W_pv", "Yb_2", "O", "Li_sv"]);
        let moment = |symbol: &str| entries.initial_magnetic_moments[&symbol.parse().unwrap()];
        assert_eq!((moment("Eu"), moment("Co"), entries.default_magnetic_moment), (10.0, 0.6, 0.6));
    }

    #[test]
    fn entries_of_the_settings_come_first() {
        let mut settings = with_table(&["Fe", "O"]);
        settings.pseudopotential_variants = [("Fe".parse().unwrap(), "Fe".to_owned())].into();
        settings.initial_magnetic_moments =
            [("O".parse().unwrap(), 1.0), ("Al".parse().unwrap(), 3.0)].into();
        let filled = ElementTable::MpRelaxSet.fill(&settings).unwrap();
        let written_out = VaspSettings {
            pseudopotential_variants: species(&["Fe", "O"])
                .into_iter()
                .zip(["Fe".into(), "O".into()])
                .collect(),
            initial_magnetic_moments: [("Fe".parse().unwrap(), 5.0)].into(),
            ..VaspSettings::default()
        };
        assert_eq!(filled, written_out);
        // Without a list, every element of the table may occur.
        settings.elements.clear();
        assert_eq!(ElementTable::MpRelaxSet.fill(&settings).unwrap().pseudopotential_variants.len(), 89);
    }

    #[test]
    fn elements_and_files_that_are_missing_or_wrong_are_named() {
        let unknown = ElementTable::MpRelaxSet.fill(&with_table(&["Fe", "Po"])).unwrap_err().to_string();
        assert!(unknown.contains("Po") && unknown.contains("the table MPRelaxSet has none"), "{unknown}");
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("mine.toml");
        let fault = |text: &str| {
            std::fs::write(&path, text).unwrap();
            ElementTable::File(path.clone()).fill(&with_table(&["Fe"])).map(drop).unwrap_err().to_string()
        };
        for text in [
            "[pseudopotential_variants]\nFe = 1",
            "[variants]\nFe = \"Fe\"",
            "[pseudopotential_variants]\nFx = \"Fe\"",
        ] {
            let message = fault(text);
            assert!(message.contains("element_table") && message.contains("mine.toml"), "{message}");
        }
        let message = fault("default_magnetic_moment = inf\n[pseudopotential_variants]\nFe = \"Fe\"");
        assert!(message.contains("mine.toml with a moment of inf"), "{message}");
        std::fs::write(&path, "default_magnetic_moment = 0.6\n[pseudopotential_variants]\nFe = \"Fe_sv\"")
            .unwrap();
        let filled = ElementTable::File(path.clone()).fill(&with_table(&["Fe"])).unwrap();
        let iron = "Fe".parse().unwrap();
        assert_eq!(
            (filled.pseudopotential_variants[&iron].as_str(), filled.initial_magnetic_moments[&iron]),
            ("Fe_sv", 0.6)
        );
        std::fs::remove_file(&path).unwrap();
        let message = ElementTable::File(path.clone()).fill(&with_table(&["Fe"])).unwrap_err().to_string();
        assert!(message.contains("mine.toml: No such file"), "{message}");
    }
}
