//! `label.method`: the method that computes labels.

use std::fmt;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::de::{Error, IntoDeserializer, MapAccess, Visitor, value::MapAccessDeserializer};
use serde::{Deserialize, Deserializer, Serialize};
use toml::Spanned;

use super::PotentialConfig;

/// Other names of Quantum ESPRESSO.
const ESPRESSO: [&str; 7] =
    ["quantum_espresso", "quantumespresso", "quantum-espresso", "qe", "pwscf", "pw", "pw.x"];

/// Names of programs that ASE has calculators for.
const THROUGH_ASE: [&str; 20] = [
    "aims",
    "fhi_aims",
    "fhi-aims",
    "castep",
    "siesta",
    "dftb",
    "dftbplus",
    "orca",
    "gaussian",
    "nwchem",
    "elk",
    "exciting",
    "openmx",
    "octopus",
    "turbomole",
    "psi4",
    "dmol",
    "onetep",
    "mace",
    "lammps",
];

/// The method that computes labels: a table with one key, the name of the method.
#[derive(Clone, Debug, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LabelMethod {
    /// A potential that calmwalk evaluates.
    Potential(PotentialConfig),
    /// A program.
    #[serde(untagged)]
    Code(Box<dft::DftSettings>),
}

impl LabelMethod {
    /// Name of the method, its key.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Potential(_) => "potential",
            Self::Code(settings) => settings.name(),
        }
    }

    /// All paths in the settings.
    pub(super) fn paths(&mut self) -> Vec<&mut PathBuf> {
        match self {
            Self::Potential(reference) => vec![Spanned::get_mut(&mut reference.file)],
            Self::Code(settings) => settings.paths().into_iter().collect(),
        }
    }
}

/// Not derived, so that an error inside a method has its own message and location instead of "no variant matches".
impl<'de> Deserialize<'de> for LabelMethod {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(Methods)
    }
}

struct Methods;

impl<'de> Visitor<'de> for Methods {
    type Value = LabelMethod;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a table with one label method, as { potential = { … } }")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<LabelMethod, A::Error> {
        let name: String = map.next_key()?.ok_or_else(|| A::Error::custom("found no label method"))?;
        if name != "potential" && !dft::DftSettings::NAMES.contains(&name.as_str()) {
            let names = dft::DftSettings::NAMES.join("`, `");
            let mut message = format!("unknown value `{name}`, expected one of `potential`, `{names}`");
            let known = name.to_ascii_lowercase();
            if ESPRESSO.contains(&known.as_str()) {
                message += "; Quantum ESPRESSO is `espresso`: see docs/dft-codes.md";
            } else if THROUGH_ASE.contains(&known.as_str()) {
                message += &format!("; {name} makes labels through `ase`: see docs/dft-codes.md");
            }
            return Err(A::Error::custom(message));
        }
        if name != "potential" {
            let settings = MapAccessDeserializer::new(Again { name: Some(name), map });
            return dft::DftSettings::deserialize(settings)
                .map(|settings| LabelMethod::Code(Box::new(settings)));
        }
        let reference = map.next_value()?;
        match map.next_key::<String>()? {
            None => Ok(LabelMethod::Potential(reference)),
            Some(second) => Err(A::Error::custom(format!("found a second label method, `{second}`"))),
        }
    }
}

/// A map whose first key has been read.
struct Again<A> {
    name: Option<String>,
    map: A,
}

impl<'de, A: MapAccess<'de>> MapAccess<'de> for Again<A> {
    type Error = A::Error;

    fn next_key_seed<K: serde::de::DeserializeSeed<'de>>(
        &mut self,
        seed: K,
    ) -> Result<Option<K::Value>, A::Error> {
        match self.name.take() {
            Some(name) => seed.deserialize(name.into_deserializer()).map(Some),
            None => self.map.next_key_seed(seed),
        }
    }

    fn next_value_seed<V: serde::de::DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, A::Error> {
        self.map.next_value_seed(seed)
    }
}
