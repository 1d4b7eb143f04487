//! `calmwalk upfit`

mod display;
mod figure;
mod fine_tuning;
mod left_parts;
mod paths;
mod report;

use std::path::{Path, PathBuf};

use ::upfit::{CosineDecay, LossSettings, Optimiser, UpfitSettings};
use clap::builder::{PossibleValuesParser, TypedValueParser};

use self::display::TrainingDisplay;
use self::fine_tuning::{FineTuned, FineTuning, fine_tune};
use super::{CommandError, ExitStatus};
use crate::output::{print, print_json, print_stderr};
use crate::signals::stop_token;
use crate::structure_files::{StructureReadingArgs, file_weight};

/// Fine-tune a GRACE model on labelled structures
///
/// Trains the weights of an export (kokkos.npz, one or two layers) on energies, forces and stresses, and writes a model file
/// with the new weights, for calmwalk and LAMMPS. Labels are read as by `calm score`: energy, forces, stress or virial, or the same
/// with REF_. The result does not depend on the number of threads.
///
/// First fits a shift of the energy per element if labels and model have different zeros. --validation-share holds out whole seed
/// structures (`seed_structure` of a frame, as `calmwalk export` writes it; otherwise single frames). Writes the weights with the smallest
/// validation loss.
///
/// The new file has no mixture, since the old one does not fit the new weights: build one with `calmwalk calm build`.
///
/// Keeps its state in NEW.npz.upfit until it has written the model. After an interruption (Ctrl-C, SIGTERM, a crash), the same command
/// continues, and gives the same bytes.
#[derive(Debug, clap::Args)]
pub struct UpfitArgs {
    /// GRACE model (kokkos.npz)
    #[arg(long, value_name = "MODEL.npz")]
    model: PathBuf,
    /// Labelled structures: extended XYZ (.extxyz, .xyz), also with .gz or .zst
    #[arg(value_name = "DATA", required = true)]
    data: Vec<PathBuf>,
    #[command(flatten)]
    reading: StructureReadingArgs,
    /// File for the new model; an existing file is replaced at the end
    #[arg(long, short, value_name = "NEW.npz")]
    output: PathBuf,
    /// Passes over the training set [default: 40 with soap, 100 with adam]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    epochs: Option<u64>,
    /// Validate with the structures of this file, which must not be in DATA, and train with all of DATA; may be repeated
    #[arg(long, value_name = "FILE", conflicts_with = "validation_share")]
    validation: Vec<PathBuf>,
    /// Share of the structures of DATA for validation. Structures of one seed structure stay together, and at least the smallest such
    /// group is held out. 0: no validation; the last weights are written
    #[arg(long, value_name = "X", default_value_t = 0.1, value_parser = share)]
    validation_share: f64,
    /// Weights of the loss. demo: energy 20, forces 5, stress 20; paper: 1, 5 and 0.1, after 5/12 of the epochs 25, 1 and 0.1
    #[arg(long, value_name = "NAME", value_enum, default_value_t = LossName::Demo)]
    loss: LossName,
    /// Weight of the errors of the energy per atom [default: that of --loss]
    #[arg(long, value_name = "W", value_parser = not_negative)]
    energy_weight: Option<f64>,
    /// Weight of the errors of force components [default: that of --loss]
    #[arg(long, value_name = "W", value_parser = not_negative)]
    force_weight: Option<f64>,
    /// Weight of the errors of stress components [default: that of --loss]
    #[arg(long, value_name = "W", value_parser = not_negative)]
    stress_weight: Option<f64>,
    /// δ of the Huber loss: larger errors count linearly, eV/atom, eV/Å and eV/Å³ [default: 0.01]
    #[arg(long, value_name = "DELTA", value_parser = positive)]
    huber_delta: Option<f64>,
    /// Weight of the structures of a file of DATA, 0 or more; multiplies calmwalk_weight of a frame that has it; may be repeated
    /// [default: 1]
    #[arg(long, value_name = "FILE=W", value_parser = file_weight)]
    weight: Vec<(PathBuf, f64)>,
    /// Optimiser. soap: Adam in the eigenbases of Shampoo's preconditioners, which needs fewer epochs (docs/upfit.md); adam: Adam with
    /// AMSGrad, as gracemaker has it
    #[arg(long, value_name = "NAME", default_value = Optimiser::default().name(), value_parser = optimisers())]
    optimiser: Optimiser,
    /// Learning rate; it falls by half a cosine. With soap, it rises to this value during the first 100 updates [default: 0.05 with soap,
    /// 0.001 with adam]
    #[arg(long, value_name = "RATE", value_parser = positive)]
    learning_rate: Option<f64>,
    /// Learning rate at the end [default: a hundredth of --learning-rate]
    #[arg(long, value_name = "RATE", value_parser = not_negative)]
    min_learning_rate: Option<f64>,
    /// Structures for each update
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..))]
    batch_size: u32,
    /// Random seed of the validation set and of the order of the structures
    #[arg(long, value_name = "N", default_value_t = 42)]
    rng_seed: u64,
    /// Do not train the weights whose names begin with NAME; may be repeated. An unknown name makes calmwalk list all names
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    freeze: Vec<String>,
    /// Threads; each takes whole structures of a batch [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Validate and write a moving average of the weights with this decay at each update, such as 0.99
    #[arg(long, value_name = "X", value_parser = share)]
    average: Option<f64>,
    /// End when the validation loss has had no new minimum for this many epochs [default: never]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    patience: Option<u64>,
    /// File of the state [default: NEW.npz.upfit]
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Also draw the learning curves: loss, mean absolute errors and learning rate by epoch
    #[arg(long, value_name = "FILE.svg")]
    figure: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A set of weights of the loss.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum LossName {
    Demo,
    Paper,
}

impl UpfitArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let request = self.request()?;
        let stop = stop_token()?;
        let mut display = TrainingDisplay::new(&request.checkpoint);
        let trained = fine_tune(&request, &stop, |event| display.show(event));
        drop(display);
        let Some(FineTuned { outcome, note }) = trained? else {
            print_stderr(stopped_text(&request.checkpoint));
            return Ok(ExitStatus::Interrupted);
        };
        if self.json {
            print_json(&report::to_json(&outcome, &note, &self.output))?;
        } else {
            print(|out| report::write(out, &outcome, &self.output))?;
        }
        Ok(ExitStatus::Done)
    }

    /// What the arguments ask for.
    fn request(&self) -> Result<FineTuning, CommandError> {
        let mut data = self.reading.files(&self.data)?;
        data.set_weights(&self.weight)?;
        let is_named = !self.validation.is_empty();
        Ok(FineTuning {
            model: self.model.clone(),
            data,
            validation: is_named.then(|| self.reading.files(&self.validation)).transpose()?,
            validation_share: self.validation_share,
            settings: self.settings(),
            output: self.output.clone(),
            checkpoint: self.checkpoint_path(),
            figure: self.figure.clone(),
        })
    }

    fn checkpoint_path(&self) -> PathBuf {
        self.checkpoint.clone().unwrap_or_else(|| {
            let mut name = self.output.clone().into_os_string();
            name.push(".upfit");
            name.into()
        })
    }

    fn settings(&self) -> UpfitSettings {
        let mut loss = match self.loss {
            LossName::Demo => LossSettings::demo(),
            LossName::Paper => LossSettings::paper(),
        };
        for stage in &mut loss.stages {
            let weights = &mut stage.weights;
            weights.energy = self.energy_weight.unwrap_or(weights.energy);
            weights.forces = self.force_weight.unwrap_or(weights.forces);
            weights.stress = self.stress_weight.unwrap_or(weights.stress);
        }
        loss.delta = self.huber_delta.unwrap_or(loss.delta);
        let first = self.learning_rate.unwrap_or(self.optimiser.default_learning_rate());
        let last = self.min_learning_rate.unwrap_or(0.01 * first);
        let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
        UpfitSettings {
            epochs: self.epochs.unwrap_or(self.optimiser.default_epochs()),
            batch_size: self.batch_size as usize,
            optimiser: self.optimiser,
            loss,
            learning_rate: CosineDecay { first, last },
            seed: self.rng_seed,
            frozen: self.freeze.clone(),
            average: self.average,
            patience: self.patience,
            threads: self.threads.map_or(cores, usize::from),
        }
    }
}

/// The optimisers by their names.
fn optimisers() -> impl TypedValueParser<Value = Optimiser> {
    let named = |name: String| Optimiser::ALL.into_iter().find(|optimiser| optimiser.name() == name);
    PossibleValuesParser::new(Optimiser::ALL.map(Optimiser::name))
        .try_map(move |name| named(name).ok_or("not an optimiser"))
}

fn stopped_text(checkpoint: &Path) -> String {
    match checkpoint.exists() {
        true => format!("stopped; the same command continues from {}", checkpoint.display()),
        false => "stopped before the first update; the same command begins again".to_owned(),
    }
}

fn number(text: &str, is_valid: impl Fn(f64) -> bool, expected: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number: &f64| number.is_finite() && is_valid(*number));
    number.ok_or_else(|| format!("expected {expected}"))
}

fn share(text: &str) -> Result<f64, String> {
    number(text, |x| (0.0..1.0).contains(&x), "a number from 0 up to, not including, 1")
}

fn positive(text: &str) -> Result<f64, String> {
    number(text, |x| x > 0.0, "a positive number")
}

fn not_negative(text: &str) -> Result<f64, String> {
    number(text, |x| x >= 0.0, "a number, 0 or more")
}
