//! `calmwalk calm compare`

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use analysis::{SystematicSample, quantile, spearman};
use calm::{Artifact, Grades};
use serde::Serialize;

use crate::artifact_checks::load_artifact;
use crate::cli::{CommandError, ExitStatus};
use crate::features::FeatureCalculator;
use crate::loaded_model::LoadedModel;
use crate::output::{self, Bar, TextTable, decimals, print, print_json};
use crate::structure_files::{FileLine, StructureArgs};

/// Atoms of each element whose grades are kept for quantiles and ranks.
const SAMPLED: usize = 50_000;

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

/// Compare the grades of two CALM artifacts of one model on the same structures
///
/// Shows for each element the median and 99 % quantile of γ under both artifacts, the share of atoms with γ > 1 under A, under B, and under
/// only one of them, and the rank correlation ρ of the two grades (Spearman). Shares count every atom; quantiles and ρ come from a sample
/// of at most 50,000 atoms.
#[derive(Debug, clap::Args)]
pub struct CalmCompareArgs {
    /// GRACE model (kokkos.npz) that both artifacts belong to
    #[arg(long, value_name = "MODEL.npz")]
    model: PathBuf,
    /// First CALM artifact
    #[arg(value_name = "A.npz")]
    first: PathBuf,
    /// Second CALM artifact
    #[arg(value_name = "B.npz")]
    second: PathBuf,
    #[command(flatten)]
    data: StructureArgs,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The grades of the atoms of an element.
struct Grading {
    sample: SystematicSample<[f64; 2]>,
    /// Atoms above 1 under the first artifact only, the second only, and both.
    above: [u64; 3],
}

/// What is said of an element. Pairs are of the first and the second artifact.
#[derive(Debug, Serialize)]
struct Comparison {
    element: String,
    atoms: u64,
    /// Median of γ.
    median: [f64; 2],
    /// 99 % quantile of γ.
    percentile_99: [f64; 2],
    /// Share of the atoms with γ > 1.
    above_1: [f64; 2],
    /// Share of the atoms with γ > 1 under this artifact only.
    only: [f64; 2],
    /// Spearman's rank correlation of the two grades; null if it is not defined.
    rank_correlation: Option<f64>,
}

impl CalmCompareArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let model = LoadedModel::load(&self.model)?;
        let (model, first) = load_artifact(model, &self.first).map_err(CommandError::Input)?;
        let (model, second) = load_artifact(model, &self.second).map_err(CommandError::Input)?;
        let artifacts = [first, second];
        let symbols = artifacts[0].symbols.clone();
        let gradings = self.grade(&model, &artifacts)?;
        let found = symbols.iter().zip(&gradings).filter_map(|(symbol, grading)| grading.compare(symbol));
        let found: Vec<_> = found.collect();
        if self.json {
            print_json(&found)?;
        } else {
            self.report(&found)?;
        }
        Ok(ExitStatus::Done)
    }

    /// The grades of all atoms, by element.
    fn grade(&self, model: &LoadedModel, artifacts: &[Artifact; 2]) -> Result<Vec<Grading>, CommandError> {
        let dimension = model.dimension();
        let mut gradings: Vec<_> = model.elements().iter().map(|_| Grading::new()).collect();
        let mut calculator = FeatureCalculator::new(model.shared());
        let files = self.data.files()?;
        let read = Arc::new(AtomicU64::new(0));
        let bar = Bar::new(Some(files.total_bytes()?), BAR);
        let mut structures = files.reader(Arc::clone(&read));
        let mut grades = [Grades::default(), Grades::default()];
        let mut count = 0;
        while let Some((frame, file)) = structures.next()? {
            let position = FileLine { file: file.path, line: frame.line };
            let elements = calculator.compute(&frame.structure).map_err(|error| position.wrong(error))?;
            let features = &calculator.potential.features()[..elements.len() * dimension];
            for (grades, artifact) in grades.iter_mut().zip(artifacts) {
                grades
                    .evaluate(&artifact.mixture, &elements, features, None)
                    .map_err(|error| position.wrong(error))?;
            }
            for (atom, element) in elements.into_iter().enumerate() {
                gradings[element].add([grades[0].gamma[atom], grades[1].gamma[atom]]);
            }
            count += 1;
            bar.set(read.load(Ordering::Relaxed), || output::count(count, "structure"));
        }
        Ok(gradings)
    }

    fn report(&self, found: &[Comparison]) -> Result<(), CommandError> {
        let titles = [
            "element",
            ">atoms",
            ">median A",
            ">median B",
            ">99 % A",
            ">99 % B",
            ">γ > 1 A",
            ">γ > 1 B",
            ">only A",
            ">only B",
            ">ρ",
        ];
        let mut table = TextTable::new(&titles);
        for one in found {
            let mut row = vec![one.element.clone(), one.atoms.to_string()];
            row.extend(
                [one.median, one.percentile_99].as_flattened().iter().map(|gamma| format!("{gamma:.2}")),
            );
            row.extend(
                [one.above_1, one.only].as_flattened().iter().map(|share| format!("{:.2} %", 100.0 * share)),
            );
            row.push(decimals(one.rank_correlation, 3));
            table.push(row);
        }
        print(|out| {
            writeln!(out, "A {}", self.first.display())?;
            writeln!(out, "B {}", self.second.display())?;
            table.write(out)
        })
    }
}

impl Grading {
    fn new() -> Self {
        Self { sample: SystematicSample::new(SAMPLED), above: [0; 3] }
    }

    fn add(&mut self, gamma: [f64; 2]) {
        match gamma.map(|gamma| gamma > 1.0) {
            [true, false] => self.above[0] += 1,
            [false, true] => self.above[1] += 1,
            [true, true] => self.above[2] += 1,
            [false, false] => {}
        }
        self.sample.add(gamma);
    }

    /// `None` without atoms.
    fn compare(&self, symbol: &str) -> Option<Comparison> {
        let column = |index: usize| self.sample.items().map(|pair| pair[index]).collect::<Vec<_>>();
        let columns = [column(0), column(1)];
        let ascending = columns.clone().map(|mut values| {
            values.sort_by(f64::total_cmp);
            values
        });
        let quantiles = |q: f64| Some([quantile(&ascending[0], q)?, quantile(&ascending[1], q)?]);
        let share = |number: u64| number as f64 / self.sample.total() as f64;
        let [first, second, both] = self.above;
        Some(Comparison {
            element: symbol.to_owned(),
            atoms: self.sample.total(),
            median: quantiles(0.5)?,
            percentile_99: quantiles(0.99)?,
            above_1: [share(first + both), share(second + both)],
            only: [share(first), share(second)],
            rank_correlation: spearman(&columns[0], &columns[1]),
        })
    }
}
