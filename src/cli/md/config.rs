//! The configuration of `calmwalk md`: a TOML file; unknown keys are errors.

use std::num::NonZeroU64;
use std::path::{Path, PathBuf};

use atoms::{Potential, extxyz::Frame, read_structures};
use calm::rules::Positive;
use md::{BarostatSettings, ThermostatSettings};
use potentials::grace::Threads;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use toml::Spanned;

use crate::cli::CommandError;
use crate::config::{
    ConfigError, Document, KnownKeys, PotentialConfig, PotentialSection, PythonSection, location_of_offset,
    read_text, wrong_barostat, wrong_thermostat,
};
use crate::loaded_model::LoadedModel;
use crate::output::log_and_warn;

/// Placeholder values for invalid required keys, so that the other keys can be checked too.
const PLACEHOLDERS: &str = r#"
structure = "-"
dynamics = { steps = 0, temperature = 300.0, thermostat = { none = {} } }
output = { trajectory = "-" }
"#;

/// Placeholders of the two forms of `[potential]`.
const POTENTIAL_FILE: &str = "potential = { kind = \"grace\", file = \"-\" }";
const POTENTIAL_MODEL: &str = "potential = { model = \"-\" }";

/// The file. Input paths are relative to its directory, output paths to the working directory.
#[derive(Debug)]
pub struct MdConfig {
    /// The dynamics starts from the first frame of this file.
    pub structure: Spanned<PathBuf>,
    /// File of the potential.
    pub potential: Spanned<PathBuf>,
    /// Integration.
    pub dynamics: DynamicsSection,
    /// Output files.
    pub output: OutputSection,
}

/// The file as it stands, with one form of `[potential]`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MdFile<P> {
    structure: Spanned<PathBuf>,
    potential: P,
    dynamics: DynamicsSection,
    output: OutputSection,
}

/// `[dynamics]`
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DynamicsSection {
    /// Number of steps.
    pub steps: u64,
    /// Temperature of the initial velocities and of the thermostat, K.
    pub temperature: Positive,
    /// Time step, fs. Default: 2 fs, or 0.5 fs with H, He, Li or Be.
    pub time_step: Option<Positive>,
    /// Random seed of the initial velocities and Langevin forces.
    #[serde(default = "one")]
    pub rng_seed: u64,
    /// `{ none = {} }` for constant energy, or a thermostat.
    pub thermostat: ThermostatSettings,
    /// Constant pressure. Default: the cell is fixed.
    pub barostat: Option<BarostatSettings>,
    /// Skin of the neighbour list, Å; does not affect results.
    #[serde(default = "skin")]
    pub skin: Positive,
}

/// `[output]`
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputSection {
    /// Extended XYZ; an existing file is overwritten.
    pub trajectory: PathBuf,
    /// Steps between frames.
    #[serde(default = "hundred")]
    pub every: NonZeroU64,
    /// Steps between lines on standard error. Default: `every`.
    pub log_every: Option<NonZeroU64>,
}

impl MdConfig {
    /// Reads and checks the configuration, its structure and its potential. The program of a model in Python is started.
    pub fn load(path: &Path) -> Result<(Self, Frame, Box<dyn Potential>), CommandError> {
        let text = read_text(path)?;
        let document = Document::parse(path, &text)?;
        let known = KnownKeys::new().with::<DynamicsSection>("dynamics").with::<OutputSection>("output");
        let (config, potential) = if document.has("potential", "model") {
            let known = known.with::<PotentialSection>("potential").with::<PythonSection>("potential.python");
            let file: MdFile<PotentialSection> = read(path, document, POTENTIAL_MODEL, &known)?;
            let model = LoadedModel::from_configuration(path)?.shared();
            (
                file.with_potential(|section| section.model),
                model.evaluator(Threads::default()) as Box<dyn Potential>,
            )
        } else {
            let mut file: MdFile<PotentialConfig> = read(path, document, POTENTIAL_FILE, &known)?;
            let potential_file = file.potential.file.get_mut();
            *potential_file = beside(path, potential_file);
            let wrong = |error| wrong_file(path, &text, "potential.file", &file.potential.file, error);
            let potential = file.potential.load().map_err(wrong)?;
            (file.with_potential(|potential| potential.file), potential)
        };
        let mut config = config;
        *config.structure.get_mut() = beside(path, config.structure.get_ref());
        let start = config.start(&*potential);
        let start = start.map_err(|error| wrong_file(path, &text, "structure", &config.structure, error))?;
        Ok((config, start, potential))
    }

    /// The first frame of the structure file, after a check of its elements.
    fn start(&self, potential: &dyn Potential) -> Result<Frame, String> {
        let path = self.structure.get_ref();
        let frames = read_structures(path).map_err(|error| error.to_string())?;
        let start = frames.into_iter().next().ok_or_else(|| format!("{}: no structures", path.display()))?;
        let at = format!("{}:{}", path.display(), start.line);
        start.structure.validate().map_err(|error| format!("{at}: {error}"))?;
        let known = potential.species();
        if let Some((atom, species)) =
            start.structure.species.iter().enumerate().find(|(_, s)| !known.contains(s))
        {
            let known: Vec<_> = known.iter().map(|species| species.symbol()).collect();
            return Err(format!(
                "{at}: atom {atom} is {species}; the potential supports {}",
                known.join(", ")
            ));
        }
        let DynamicsSection { temperature, thermostat, barostat, .. } = &self.dynamics;
        let fault = |it: &BarostatSettings| it.fault(temperature.get(), thermostat, &start.structure);
        match barostat.as_ref().and_then(fault) {
            Some(fault) => Err(format!("{at}: dynamics.barostat: {fault}")),
            None => Ok(start),
        }
    }
}

impl<P> MdFile<P> {
    fn with_potential(self, file: impl Fn(P) -> Spanned<PathBuf>) -> MdConfig {
        let Self { structure, potential, dynamics, output } = self;
        MdConfig { structure, potential: file(potential), dynamics, output }
    }
}

/// Reads one form of the file, with the placeholders of its potential.
fn read<P: DeserializeOwned>(
    path: &Path,
    mut document: Document<'_>,
    potential: &str,
    known: &KnownKeys,
) -> Result<MdFile<P>, ConfigError> {
    let config: Option<MdFile<P>> = document.read(&format!("{PLACEHOLDERS}{potential}\n"), known);
    let warnings = document.check_ranges("dynamics");
    document.check_rules(|| {
        let dynamics = config.as_ref().map(|config| &config.dynamics);
        let wrong = |it: &DynamicsSection| {
            let barostat = it.barostat.and_then(|barostat| wrong_barostat(&barostat, "dynamics"));
            wrong_thermostat(&it.thermostat, "dynamics").or(barostat)
        };
        dynamics.and_then(wrong).into_iter().collect()
    });
    document.finish()?;
    warnings.iter().for_each(log_and_warn);
    config.ok_or_else(|| ConfigError::unreadable(path))
}

/// A path relative to the directory of the configuration.
fn beside(configuration: &Path, file: &Path) -> PathBuf {
    configuration.parent().unwrap_or(Path::new("")).join(file)
}

fn wrong_file(path: &Path, text: &str, key: &str, file: &Spanned<PathBuf>, message: String) -> ConfigError {
    ConfigError::File { at: location_of_offset(path, text, file.span().start), key: key.to_owned(), message }
}

fn one() -> u64 {
    1
}

fn skin() -> Positive {
    Positive::try_from(0.5).expect("a number above 0")
}

fn hundred() -> NonZeroU64 {
    NonZeroU64::new(100).expect("a number above 0")
}
