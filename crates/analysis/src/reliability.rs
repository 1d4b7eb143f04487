//! Whether predicted probabilities are those with which events happen.

use crate::wilson_interval;

/// Predicted probabilities of events and whether they happened, in bins of equal width from 0 to 1: the reliability diagram
/// of forecasts (Murphy and Winkler, Appl. Stat. 26, 41, 1977), and the Brier score (Brier, Mon. Weather Rev. 78, 1, 1950).
#[derive(Clone, Debug, PartialEq)]
pub struct ReliabilityDiagram {
    bins: Vec<ReliabilityCounts>,
    squares: f64,
}

#[derive(Clone, Debug, Default, PartialEq)]
struct ReliabilityCounts {
    number: u64,
    happened: u64,
    predicted: f64,
}

/// The predictions in one bin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReliabilityBin {
    /// Lower edge.
    pub from: f64,
    /// Upper edge.
    pub to: f64,
    /// Number of predictions.
    pub number: u64,
    /// Mean predicted probability; `None` without predictions.
    pub predicted: Option<f64>,
    /// Share of events that happened; `None` without predictions.
    pub observed: Option<f64>,
    /// 95 % confidence interval of their probability ([`wilson_interval`]).
    pub interval: Option<(f64, f64)>,
}

impl ReliabilityDiagram {
    /// An empty diagram with this number of bins, at least one.
    pub fn new(bins: usize) -> Self {
        Self { bins: vec![ReliabilityCounts::default(); bins.max(1)], squares: 0.0 }
    }

    /// Adds a prediction, a probability from 0 to 1. Others are ignored.
    pub fn add(&mut self, predicted: f64, happened: bool) {
        if !(0.0..=1.0).contains(&predicted) {
            return;
        }
        let last = self.bins.len() - 1;
        let bin = &mut self.bins[((predicted * (last + 1) as f64) as usize).min(last)];
        bin.number += 1;
        bin.happened += u64::from(happened);
        bin.predicted += predicted;
        self.squares += (predicted - f64::from(u8::from(happened))).powi(2);
    }

    /// Number of predictions.
    pub fn number(&self) -> u64 {
        self.bins.iter().map(|bin| bin.number).sum()
    }

    /// Share of events that happened; `None` without predictions.
    pub fn observed(&self) -> Option<f64> {
        let happened: u64 = self.bins.iter().map(|bin| bin.happened).sum();
        (self.number() > 0).then(|| happened as f64 / self.number() as f64)
    }

    /// Mean square of predicted probability minus outcome (1 or 0); `None` without predictions.
    pub fn brier_score(&self) -> Option<f64> {
        (self.number() > 0).then(|| self.squares / self.number() as f64)
    }

    /// The Brier score of the observed share as the prediction of every event, p (1 − p): a model must have a lower one.
    pub fn brier_score_of_share(&self) -> Option<f64> {
        self.observed().map(|share| share * (1.0 - share))
    }

    /// The bins, ascending.
    pub fn bins(&self) -> Vec<ReliabilityBin> {
        let edge = |k: usize| k as f64 / self.bins.len() as f64;
        let bin = |(k, counts): (usize, &ReliabilityCounts)| {
            let of_all = |sum: f64| (counts.number > 0).then(|| sum / counts.number as f64);
            ReliabilityBin {
                from: edge(k),
                to: edge(k + 1),
                number: counts.number,
                predicted: of_all(counts.predicted),
                observed: of_all(counts.happened as f64),
                interval: wilson_interval(counts.happened, counts.number),
            }
        };
        self.bins.iter().enumerate().map(bin).collect()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// sklearn.calibration.calibration_curve(y, p, n_bins=4) = [0.5, 0, 1, 0.75], [0.1, 0.3, 0.6, 0.9];
    /// brier_score_loss(y, p) = 0.24125 (scikit-learn 1.9.1).
    #[test]
    fn bins_are_those_of_scikit_learn() {
        let mut diagram = ReliabilityDiagram::new(4);
        let predictions = [
            (0.1, true),
            (0.1, false),
            (0.3, false),
            (0.6, true),
            (0.8, true),
            (0.9, false),
            (0.9, true),
            (1.0, true),
        ];
        predictions.into_iter().for_each(|(predicted, happened)| diagram.add(predicted, happened));
        diagram.add(f64::NAN, true);
        let bins = diagram.bins();
        let observed: Vec<_> = bins.iter().map(|bin| bin.observed.unwrap()).collect();
        assert_eq!(observed, [0.5, 0.0, 1.0, 0.75]);
        for (bin, expected) in bins.iter().zip([0.1, 0.3, 0.6, 0.9]) {
            assert!((bin.predicted.unwrap() - expected).abs() < 1e-12, "{bin:?}");
        }
        assert_eq!((bins[3].from, bins[3].to, bins[3].number), (0.75, 1.0, 4));
        assert_eq!((bins[3].interval, diagram.number()), (wilson_interval(3, 4), 8));
        assert!((diagram.brier_score().unwrap() - 0.24125).abs() < 1e-12, "{:?}", diagram.brier_score());
        assert_eq!(diagram.brier_score_of_share(), Some(0.625 * 0.375));
        let empty = ReliabilityDiagram::new(0);
        assert_eq!((empty.brier_score(), empty.bins().len(), empty.bins()[0].observed), (None, 1, None));
    }

    proptest! {
        #[test]
        fn every_prediction_is_in_a_bin(predictions in prop::collection::vec((0.0..=1.0_f64, any::<bool>()), 0..99), bins in 1_usize..12) {
            let mut diagram = ReliabilityDiagram::new(bins);
            predictions.iter().for_each(|(predicted, happened)| diagram.add(*predicted, *happened));
            prop_assert_eq!(diagram.number(), predictions.len() as u64);
            for bin in diagram.bins().iter().filter(|bin| bin.number > 0) {
                let predicted = bin.predicted.unwrap();
                prop_assert!(bin.from - 1e-12 <= predicted && predicted <= bin.to + 1e-12, "{:?}", bin);
            }
        }
    }
}
