//! Other thresholds for a mixture that exists, from its stored histograms.

use std::io::{self, Read, Seek, Write};

use npz::Writer;

use super::histogram::{ElementHistograms, SigmaHistogram};
use super::thresholds::{ThresholdRule, Thresholds};

/// The thresholds of an artifact, by the rule, for its histograms ([`read_histograms`](super::read_histograms)).
#[derive(Debug, Clone, PartialEq)]
pub struct Recalibration {
    rule: ThresholdRule,
    elements: Vec<Thresholds>,
    slots: usize,
}

impl Recalibration {
    /// `dimension` is the feature dimension D of the mixture.
    pub fn new(rule: ThresholdRule, dimension: usize, histograms: &[Option<ElementHistograms>]) -> Self {
        let slots = histograms.iter().flatten().map(|element| element.components.len()).max().unwrap_or(1);
        let of = |element: &Option<ElementHistograms>| {
            let mut element = element.clone().unwrap_or_else(|| ElementHistograms::empty(0));
            element.components.resize_with(slots, SigmaHistogram::default);
            element.thresholds(rule, dimension)
        };
        Self { rule, elements: histograms.iter().map(of).collect(), slots }
    }

    /// The thresholds of every slot of each element.
    pub fn elements(&self) -> &[Thresholds] {
        &self.elements
    }

    /// Writes a copy of the artifact with these thresholds. All other arrays are copied byte by byte.
    ///
    /// # Errors
    /// If reading or writing fails.
    pub fn write_artifact<R: Read + Seek, W: Write + Seek>(&self, artifact: R, out: W) -> io::Result<W> {
        const KEYS: [&str; 3] = ["interp_thresholds", "eff_interp_thresholds", "threshold_mode"];
        let mut file = Writer::new(out);
        file.copy(artifact, |key| KEYS.contains(&key))?;
        let shape = [self.elements.len(), self.slots];
        file.array(KEYS[0], &shape, self.single(|thresholds| &thresholds.raw))?;
        file.array(KEYS[1], &shape, self.single(|thresholds| &thresholds.weighted))?;
        file.strings(KEYS[2], &[], &[&self.rule.name()])?;
        file.finish()
    }

    /// Writes a copy of the export of a model that has this mixture, with these thresholds. All other arrays are copied
    /// byte by byte.
    ///
    /// # Errors
    /// If reading or writing fails.
    pub fn write_export<R: Read + Seek, W: Write + Seek>(&self, model: R, out: W) -> io::Result<W> {
        const KEY: &str = "uq_interp_thresholds";
        let mut file = Writer::new(out);
        file.copy(model, |key| key == KEY)?;
        let shape = [self.elements.len(), self.slots];
        file.array(KEY, &shape, self.single(|thresholds| &thresholds.weighted))?;
        file.finish()
    }

    fn single(&self, of: impl Fn(&Thresholds) -> &Vec<f64>) -> Vec<f32> {
        self.elements.iter().flat_map(|thresholds| of(thresholds).clone()).map(|value| value as f32).collect()
    }
}
