//! Traces of the biased walks, by group: of each of a few walks, or the range over many.

use std::collections::BTreeMap;

use analysis::quantile;
use store::{CampaignStatus, Store, StoreError, WalkStatus};
use wire::{Origin, TracePoint, WalkId};

/// Largest number of walks with a line each.
const MAX_LINES: usize = 8;
/// Largest number of groups shown.
const MAX_GROUPS: usize = 12;
/// Number of equal pieces of the walks over which many walks are summarised.
const PIECES: usize = 100;

/// A quantity of a point.
pub struct TraceQuantity {
    /// Its name in files.
    pub key: &'static str,
    /// Its name with its unit on an axis.
    pub title: &'static str,
    /// Its value.
    pub of: fn(&TracePoint) -> Option<f64>,
}

/// The quantities in the order of the panels.
pub static QUANTITIES: [TraceQuantity; 9] = [
    TraceQuantity { key: "temperature", title: "temperature (K)", of: |point| Some(point.temperature) },
    TraceQuantity { key: "pressure", title: "pressure (GPa)", of: |point| point.pressure },
    TraceQuantity { key: "relative_volume", title: "V/V_{0}", of: |point| Some(point.relative_volume) },
    TraceQuantity { key: "gamma_max", title: "γ_{max}", of: |point| point.gamma_max },
    TraceQuantity { key: "gamma_max_original", title: "γ_{0,max}", of: |point| point.gamma_max_original },
    TraceQuantity { key: "bias_scale", title: "τ_{r} (eV)", of: |point| Some(point.bias_scale) },
    TraceQuantity { key: "cell_gain", title: "τ_{s}", of: |point| Some(point.cell_gain) },
    TraceQuantity {
        key: "bias_share",
        title: "share of the bias (%)",
        of: |point| Some(100.0 * point.bias_share),
    },
    TraceQuantity { key: "bias_work", title: "work of the bias (eV)", of: |point| Some(point.bias_work) },
];

/// The biased walks of a group.
pub struct GroupTraces {
    /// Name of the group; empty without groups.
    pub group: String,
    /// Number of walks with a trace.
    pub walks: usize,
    /// Time step, fs, if it is the same of all.
    pub time_step: Option<f64>,
    /// What is drawn.
    pub content: TraceContent,
}

/// What is drawn of a group.
pub enum TraceContent {
    /// Every point of each walk.
    Lines(Vec<(u32, Vec<TracePoint>)>),
    /// The range over the walks by piece.
    Ranges(Vec<TraceRange>),
}

/// The values of a quantity over the walks, in one piece of them.
pub struct TraceRange {
    /// Index in [`QUANTITIES`].
    pub quantity: usize,
    /// Step in the middle of the piece.
    pub step: f64,
    /// Number of walks.
    pub walks: usize,
    /// Smallest, median and largest mean of a walk in the piece.
    pub values: [f64; 3],
}

/// Reads the traces of the biased walks with this version of the potential.
pub async fn read(
    store: &Store,
    status: &CampaignStatus,
    version: u32,
) -> Result<Vec<GroupTraces>, StoreError> {
    let mut groups = BTreeMap::<&str, Vec<&WalkStatus>>::new();
    for walk in &status.walks {
        let conditions = walk.conditions.as_ref();
        if walk.origin == Origin::Biased.name() && conditions.map_or(0, |of| of.version) == version {
            groups.entry(conditions.map_or("", |of| &of.group)).or_default().push(walk);
        }
    }
    let mut traces = Vec::new();
    for (group, walks) in groups.into_iter().take(MAX_GROUPS) {
        traces.extend(GroupTraces::read(store, group, &walks).await?);
    }
    Ok(traces)
}

impl GroupTraces {
    async fn read(store: &Store, group: &str, walks: &[&WalkStatus]) -> Result<Option<Self>, StoreError> {
        let last = walks.iter().map(|walk| walk.step).max().unwrap_or(0);
        let (mut lines, mut pieces) = (Vec::new(), PieceMeans::new(last));
        let (mut number, mut time_steps) = (0, Vec::new());
        for walk in walks {
            let points = store.walk_trace(WalkId(walk.walk)).await?;
            if points.is_empty() {
                continue;
            }
            number += 1;
            time_steps
                .extend(points.last().filter(|last| last.step > 0).map(|last| last.time / last.step as f64));
            pieces.add(&points);
            if number <= MAX_LINES {
                lines.push((walk.walk, points));
            }
        }
        let time_step = time_steps.first().copied();
        let same = |first: &f64| time_steps.iter().all(|other| (other / first - 1.0).abs() < 1e-9);
        Ok((number > 0).then(|| Self {
            group: group.to_owned(),
            walks: number,
            time_step: time_step.filter(same),
            content: match number <= MAX_LINES {
                true => TraceContent::Lines(lines),
                false => TraceContent::Ranges(pieces.ranges()),
            },
        }))
    }
}

/// The means of the walks by piece and quantity.
struct PieceMeans {
    length: f64,
    means: Vec<[Vec<f64>; QUANTITIES.len()]>,
}

impl PieceMeans {
    fn new(last: u64) -> Self {
        Self {
            length: (last + 1) as f64 / PIECES as f64,
            means: (0..PIECES).map(|_| Default::default()).collect(),
        }
    }

    fn add(&mut self, points: &[TracePoint]) {
        let mut sums = vec![[(0.0, 0_u32); QUANTITIES.len()]; PIECES];
        for point in points {
            let piece = (point.step as f64 / self.length) as usize;
            let Some(sums) = sums.get_mut(piece) else { continue };
            for (sum, quantity) in sums.iter_mut().zip(&QUANTITIES) {
                if let Some(value) = (quantity.of)(point) {
                    *sum = (sum.0 + value, sum.1 + 1);
                }
            }
        }
        for (means, sums) in self.means.iter_mut().zip(sums) {
            for (means, (sum, count)) in means.iter_mut().zip(sums) {
                means.extend((count > 0).then(|| sum / f64::from(count)));
            }
        }
    }

    fn ranges(mut self) -> Vec<TraceRange> {
        let mut ranges = Vec::new();
        for (piece, means) in self.means.iter_mut().enumerate() {
            let step = (piece as f64 + 0.5) * self.length;
            for (quantity, means) in means.iter_mut().enumerate() {
                means.sort_by(f64::total_cmp);
                let (Some(least), Some(most)) = (means.first(), means.last()) else { continue };
                let Some(median) = quantile(means, 0.5) else { continue };
                ranges.push(TraceRange {
                    quantity,
                    step,
                    walks: means.len(),
                    values: [*least, median, *most],
                });
            }
        }
        ranges.sort_by_key(|range| range.quantity);
        ranges
    }
}
