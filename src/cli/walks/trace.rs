//! `calmwalk walks trace`

use std::io::Write;
use std::path::PathBuf;

use monitor::walk_trace::WalkTrace;
use store::{Location, Store};
use wire::{TracePoint, WalkId};

use super::walk_number;
use crate::atomic_file::{AtomicFile, cannot_write};
use crate::cli::CommandError;
use crate::csv::{Csv, number};
use crate::output::print;

/// Names of the columns, in the order of [`row`].
const COLUMNS: [&str; 20] = [
    "number",
    "segment",
    "step",
    "time",
    "temperature",
    "pressure",
    "relative_volume",
    "a",
    "b",
    "c",
    "alpha",
    "beta",
    "gamma",
    "conserved_energy",
    "gamma_max",
    "bias_scale",
    "cell_gain",
    "bias_share",
    "bias_work",
    "gamma_max_original",
];

#[derive(Debug, clap::Args)]
pub struct TraceArgs {
    /// Number of the walk, as in calmwalk status
    #[arg(value_parser = walk_number)]
    walk: u32,
    /// File for the points [default: standard output]
    #[arg(long, value_name = "FILE.csv")]
    output: Option<PathBuf>,
}

impl TraceArgs {
    pub async fn run(self, location: &Location) -> Result<(), CommandError> {
        let store = Store::open_read_only(location).await?;
        let trace = WalkTrace::read(&store, WalkId(self.walk)).await?;
        store.close().await;
        let mut csv = Csv::new(&COLUMNS);
        trace.points.iter().for_each(|point| csv.push(&row(point)));
        let bytes = csv.into_bytes();
        let Some(path) = self.output else { return print(|out| out.write_all(&bytes)) };
        let mut file = AtomicFile::create(&path)?;
        file.write_all(&bytes).map_err(|error| cannot_write(&path, error))?;
        file.finish()
    }
}

fn row(point: &TracePoint) -> Vec<String> {
    let mut cells = vec![point.number.to_string(), point.segment.to_string(), point.step.to_string()];
    let numbers = [Some(point.time), Some(point.temperature), point.pressure, Some(point.relative_volume)];
    cells.extend(numbers.map(number));
    cells.extend((0..6).map(|k| number(point.cell.map(|cell| cell[k]))));
    let bias = [point.bias_scale, point.cell_gain, point.bias_share, point.bias_work];
    cells.extend([point.conserved_energy, point.gamma_max].into_iter().chain(bias.map(Some)).map(number));
    cells.push(number(point.gamma_max_original));
    cells
}
