//! `calmwalk calm sample`

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use atoms::extxyz::{Frame, write_frame};
use atoms::{composition, element_symbol};
use calm::weighted_sample::WeightedSampler;
use tokio_util::sync::CancellationToken;

use crate::atomic_file::{AtomicFile, cannot_write, refuse_to_replace};
use crate::cli::{CommandError, ExitStatus};
use crate::loaded_model::LoadedModel;
use crate::mixture_build::{PROJECTED, projected};
use crate::output::{Bar, TextTable, count, print, print_stderr};
use crate::signals::stop_token;
use crate::structure_files::{FRAME_WEIGHT, FileLine, StructureArgs, StructureFiles};

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

/// Draw a weighted sample of structures that stands for a data set of any size
///
/// Draws whole structures at random, without replacement, until the sample has about N atoms of each element, or all there are. A structure
/// drawn for one element also counts for its other elements, so frequent elements get more.
///
/// Writes each structure with its labels and adds calmwalk_weight: the number of structures of the data that it stands for. `calm build` and
/// `upfit` multiply it by --weight of the file. Up to the random error of the sample, weighted sums over the sample equal the sums over the
/// data.
///
/// Reads the data once, and keeps only the sample in memory. The sample depends on --rng-seed and on the order of the structures.
#[derive(Debug, clap::Args)]
pub struct CalmSampleArgs {
    #[command(flatten)]
    data: StructureArgs,
    /// Number of atoms of each element. Choose several times the atoms of a structure, and more than the D + 1 that a component of a mixture
    /// needs
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    atoms_per_element: u64,
    /// File for the sample, extended XYZ; an existing file is replaced at the end
    #[arg(long, short, value_name = "SAMPLE.extxyz")]
    output: PathBuf,
    /// GRACE model (kokkos.npz): also list its elements with fewer than D + 1 atoms in the sample, including those without data
    #[arg(long, value_name = "MODEL.npz")]
    model: Option<PathBuf>,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 42)]
    rng_seed: u64,
}

/// The structures of a sample by their numbers, each with its place.
struct DrawnSample {
    sampler: WeightedSampler,
    frames: BTreeMap<u64, DrawnStructure>,
}

/// A structure with the weight that it had in the data.
struct DrawnStructure {
    frame: Frame,
    file: Arc<Path>,
    weight: f64,
}

/// The model of --model.
struct SampledModel {
    /// Atomic numbers of its elements.
    elements: Vec<u8>,
    /// D of the mixtures that `calm build` makes for it.
    dimension: u64,
}

/// What the sample has of an element.
#[derive(Default)]
struct SampledElement {
    in_data: u64,
    atoms: u64,
    structures: u64,
    /// Smallest and largest weight.
    weights: Option<(f64, f64)>,
}

impl CalmSampleArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let files = self.data.files()?;
        let data = files.paths().map(|path| (path, "a file of the data"));
        let model = self.model.iter().map(|path| (path.as_path(), "the model"));
        refuse_to_replace(&self.output, data.chain(model))?;
        // Errors in paths are found before hours of work.
        AtomicFile::create(&self.output).map(drop)?;
        let model = self.model.as_deref().map(SampledModel::load).transpose()?;
        let sampler = WeightedSampler::new(self.atoms_per_element, self.rng_seed);
        let Some(sample) = draw(&files, sampler, &stop_token()?)? else {
            print_stderr("stopped; nothing was written");
            return Ok(ExitStatus::Interrupted);
        };
        let rows = sample.rows(model.as_ref().map_or(&[][..], |model| &model.elements[..]));
        let weights = sample.write(&self.output)?;
        print(|out| {
            table(&rows).write(out)?;
            if let Some(line) = model.as_ref().and_then(|model| too_few(&rows, model.dimension)) {
                writeln!(out, "{line}")?;
            }
            let drawn = count(weights.len() as u64, "structure");
            let mean = weights.iter().sum::<f64>() / weights.len().max(1) as f64;
            let all = sample.sampler.structures();
            writeln!(out, "{drawn} of {all}, mean weight {}", rounded(mean))?;
            writeln!(out, "wrote {}", self.output.display())
        })?;
        Ok(ExitStatus::Done)
    }
}

impl SampledModel {
    fn load(path: &Path) -> Result<Self, CommandError> {
        let model = LoadedModel::load(path)?;
        let elements = model.elements().iter().map(|species| species.atomic_number()).collect();
        let (_, projection, _) = projected(path, model, None, 0, PROJECTED)?;
        Ok(Self { elements, dimension: projection.feature_dimension as u64 })
    }
}

/// Reads all structures; `None` after a cancellation.
fn draw(
    files: &StructureFiles,
    mut sampler: WeightedSampler,
    stop: &CancellationToken,
) -> Result<Option<DrawnSample>, CommandError> {
    let (bytes, mut frames) = (Arc::new(AtomicU64::new(0)), BTreeMap::new());
    let bar = Bar::new(Some(files.total_bytes()?), BAR);
    let mut reader = files.reader(Arc::clone(&bytes));
    while let Some((frame, file)) = reader.next()? {
        if stop.is_cancelled() {
            return Ok(None);
        }
        let weight = file.weight_of(&frame)?;
        let atoms = composition(&frame.structure.species).into_iter();
        let change = sampler.add(atoms.map(|(element, count)| (element, u64::from(count))).collect());
        frames.insert(change.number, DrawnStructure { frame, file: file.path, weight });
        change.dropped.iter().for_each(|number| drop(frames.remove(number)));
        let read = sampler.structures();
        bar.set(bytes.load(Ordering::Relaxed), || count(read, "structure"));
    }
    if frames.is_empty() {
        return Err(CommandError::Input(
            "the structures of the data have no atoms; expected some".to_owned(),
        ));
    }
    Ok(Some(DrawnSample { sampler, frames }))
}

impl DrawnSample {
    /// What a structure of the sample counts.
    fn weight(&self, number: u64) -> f64 {
        let before = self.frames.get(&number).map_or(1.0, |structure| structure.weight);
        before * self.sampler.weight(number).unwrap_or(1.0)
    }

    /// Each element of the data, and each of `others`, by its atomic number.
    fn rows(&self, others: &[u8]) -> BTreeMap<u8, SampledElement> {
        let mut rows: BTreeMap<u8, SampledElement> =
            others.iter().map(|element| (*element, SampledElement::default())).collect();
        for (element, in_data) in self.sampler.atoms_in_data() {
            rows.entry(element).or_default().in_data = in_data;
        }
        for (number, atoms) in self.sampler.sample() {
            let weight = self.weight(number);
            for (element, count) in atoms {
                let row = rows.entry(*element).or_default();
                row.atoms += count;
                row.structures += 1;
                let (low, high) = row.weights.unwrap_or((weight, weight));
                row.weights = Some((low.min(weight), high.max(weight)));
            }
        }
        rows
    }

    /// Writes the structures in the order of the data. Returns their weights.
    fn write(&self, output: &Path) -> Result<Vec<f64>, CommandError> {
        let mut out = AtomicFile::create(output)?;
        let mut weights = Vec::with_capacity(self.frames.len());
        for (number, DrawnStructure { frame, file, .. }) in &self.frames {
            let weight = self.weight(*number);
            let mut frame = frame.clone();
            frame.info.insert(FRAME_WEIGHT.to_owned(), weight.into());
            write_frame(&mut out, &frame).map_err(|error| {
                let place = FileLine { file: Arc::clone(file), line: frame.line };
                cannot_write(output, format_args!("{place}: {error}"))
            })?;
            weights.push(weight);
        }
        out.finish()?;
        Ok(weights)
    }
}

fn table(rows: &BTreeMap<u8, SampledElement>) -> TextTable {
    let titles = ["element", ">atoms in the data", ">in the sample", ">structures", ">weights"];
    let mut table = TextTable::new(&titles);
    for (element, row) in rows {
        let weights =
            row.weights.map_or("–".to_owned(), |(low, high)| match (rounded(low), rounded(high)) {
                (low, high) if low == high => low,
                (low, high) => format!("{low}–{high}"),
            });
        table.push(vec![
            element_symbol(*element).to_owned(),
            row.in_data.to_string(),
            row.atoms.to_string(),
            row.structures.to_string(),
            weights,
        ]);
    }
    table
}

/// Names the elements with fewer than D + 1 atoms, if there are any.
fn too_few(rows: &BTreeMap<u8, SampledElement>, dimension: u64) -> Option<String> {
    let needed = dimension + 1;
    let few = rows.iter().filter(|(_, row)| row.atoms < needed);
    let named: Vec<_> = few
        .map(|(element, row)| format!("{} {} of {}", element_symbol(*element), row.atoms, row.in_data))
        .collect();
    (!named.is_empty()).then(|| {
        format!(
            "fewer than {needed} atoms (D + 1) in the sample, which a component of a mixture needs: {}",
            named.join(", ")
        )
    })
}

/// With three significant digits, or as a whole number.
fn rounded(weight: f64) -> String {
    match weight {
        weight if weight >= 100.0 => format!("{weight:.0}"),
        weight if weight >= 10.0 => format!("{weight:.1}"),
        weight => format!("{weight:.2}"),
    }
}
