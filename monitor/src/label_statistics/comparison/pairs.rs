//! Pairs: the candidate of a biased walk and the frame of its control walk at the same step.

use std::collections::BTreeMap;

use analysis::{Bootstrap, SignTest, SignedRankTest, quantile};
use serde::Serialize;
use wire::Origin;

use super::super::frames::{ComparedFrame, ComparedFrames, FrameErrors};
use super::units::{ConfidenceEstimate, NumberedUnits, ResamplingUnits, median, median_range, sorted_values};

/// How often the candidate of a biased walk and the frame of its control walk at the same step have labels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct PairCounts {
    /// Both have a label. Only these are compared.
    pub pairs: u64,
    /// Both are the same structure, as at the first biased step. Left out: they do not differ.
    pub same_structure: u64,
    /// The label of the biased candidate failed; the control frame has one.
    pub biased_failed: u64,
    /// The label of the control frame failed; the biased candidate has one.
    pub control_failed: u64,
    /// Both labels failed.
    pub both_failed: u64,
    /// The biased candidate has a label; the control walk has no frame there, or its label is not finished.
    pub biased_alone: u64,
    /// The control frame has a label; that of the biased candidate is not finished.
    pub control_alone: u64,
}

/// Errors of the structures of pairs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairedErrors {
    /// How many pairs there are, and what is not among them.
    pub counts: PairCounts,
    /// Their seed structures and walks, and which of them the bootstrap draws.
    pub units: ResamplingUnits,
    /// Mean absolute error of the force components of a structure, eV/Å (the paper's).
    pub force_mae: PairedQuantity,
    /// Mean of |F_model − F_label| over the atoms of a structure, eV/Å.
    pub mean_force_error: PairedQuantity,
    /// |E_model − E_label| per atom without the offsets of the elements, eV.
    pub energy: PairedQuantity,
    /// Root mean square error of the six components of the stress, eV/Å³.
    pub stress: PairedQuantity,
    /// Force MAE of each pair, in the order of walks and steps.
    #[serde(skip)]
    pub points: Vec<PairPoint>,
}

/// One pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairPoint {
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Number of the biased walk.
    pub walk: u32,
    /// Step of both.
    pub step: u64,
    /// Force MAE of the biased candidate, eV/Å.
    pub biased: f64,
    /// Force MAE of the control frame, eV/Å.
    pub control: f64,
}

/// One error, on both sides of the pairs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairedQuantity {
    /// Pairs in which it is known on both sides.
    pub pairs: u64,
    /// Median over the biased candidates.
    pub biased: ConfidenceEstimate,
    /// Median over the control frames.
    pub control: ConfidenceEstimate,
    /// Difference of these medians, biased − control.
    pub difference_of_medians: ConfidenceEstimate,
    /// Median of the differences within the pairs, biased − control.
    pub median_difference: ConfidenceEstimate,
    /// The range of the median of biased candidates, whatever the errors of those whose labels failed are, control frames of the same
    /// step with or without a label. `None` without failures; without an upper end if there are too many.
    pub biased_between: Option<(f64, Option<f64>)>,
    /// The same for control frames.
    pub control_between: Option<(f64, Option<f64>)>,
    /// Tests over the pairs, as if they were independent.
    pub tests: PairedTests,
    /// Tests over one difference of each resampled unit, the median of its pairs: pairs of one unit resemble each other.
    pub tests_by_unit: PairedTests,
}

/// Tests of differences, biased − control.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct PairedTests {
    /// Differences above zero.
    pub biased_larger: u64,
    /// Differences below zero.
    pub control_larger: u64,
    /// Two-sided probability of Wilcoxon's signed-rank test; `None` without differences.
    pub wilcoxon_p: Option<f64>,
    /// Whether it is exact, and not from the normal distribution.
    pub wilcoxon_is_exact: Option<bool>,
    /// Two-sided probability of the sign test.
    pub sign_p: Option<f64>,
}

/// The pairs, and the labelled structures whose partners failed.
pub(super) struct MatchedFrames<'a> {
    /// Biased and control.
    pub pairs: Vec<[&'a ComparedFrame; 2]>,
    /// Biased candidates and control frames whose partner has no label because it failed.
    partner_failed: [Vec<&'a ComparedFrame>; 2],
    pub counts: PairCounts,
}

/// What became of the label of one side.
#[derive(Clone, Copy)]
enum SideLabel<'a> {
    Labelled(&'a ComparedFrame),
    Failed(wire::ContentHash),
}

impl SideLabel<'_> {
    fn content(&self) -> wire::ContentHash {
        match self {
            Self::Labelled(frame) => frame.content,
            Self::Failed(content) => *content,
        }
    }
}

/// Matches by biased walk and step. Where a biased walk found several structures at one step, in several segments, the first
/// labelled one counts, or the first failed one.
pub(super) fn match_frames(frames: &ComparedFrames) -> MatchedFrames<'_> {
    let mut places: BTreeMap<(u32, u64), [Option<SideLabel>; 2]> = BTreeMap::new();
    let side = |origin: Origin| usize::from(origin == Origin::Control);
    for frame in frames.labelled() {
        let sides = places.entry((frame.place.walk, frame.at.1)).or_default();
        sides[side(frame.place.origin)].get_or_insert(SideLabel::Labelled(frame));
    }
    for failed in frames.failed() {
        let sides = places.entry((failed.walk, failed.step)).or_default();
        sides[side(failed.origin)].get_or_insert(SideLabel::Failed(failed.content));
    }
    let mut matched = MatchedFrames {
        pairs: Vec::new(),
        partner_failed: [Vec::new(), Vec::new()],
        counts: PairCounts::default(),
    };
    places.into_values().for_each(|sides| matched.add(sides));
    matched
}

impl<'a> MatchedFrames<'a> {
    fn add(&mut self, sides: [Option<SideLabel<'a>>; 2]) {
        use SideLabel::{Failed, Labelled};
        let counts = &mut self.counts;
        match sides {
            [Some(biased), Some(control)] if biased.content() == control.content() => {
                counts.same_structure += 1
            }
            [Some(Labelled(biased)), Some(Labelled(control))] => {
                counts.pairs += 1;
                self.pairs.push([biased, control]);
            }
            [Some(Labelled(biased)), Some(Failed(_))] => {
                counts.control_failed += 1;
                self.partner_failed[0].push(biased);
            }
            [Some(Failed(_)), Some(Labelled(control))] => {
                counts.biased_failed += 1;
                self.partner_failed[1].push(control);
            }
            [Some(Failed(_)), Some(Failed(_))] => counts.both_failed += 1,
            [Some(Labelled(_)), None] => counts.biased_alone += 1,
            [None, Some(Labelled(_))] => counts.control_alone += 1,
            [Some(Failed(_)), None] | [None, Some(Failed(_)) | None] => {}
        }
    }

    /// Number of structures of this origin that failed and have a partner, which may have failed too.
    pub fn failed(&self, origin: Origin) -> u64 {
        let alone = match origin {
            Origin::Biased => self.counts.biased_failed,
            Origin::Control => self.counts.control_failed,
        };
        alone + self.counts.both_failed
    }
}

impl PairedErrors {
    pub(super) fn new(matched: &MatchedFrames, bootstrap: Bootstrap) -> Self {
        let units = NumberedUnits::new(matched.pairs.iter().map(|[biased, _]| biased.place));
        let quantity =
            |of: fn(&FrameErrors) -> Option<f64>| PairedQuantity::new(matched, &units, of, bootstrap);
        let point = |[biased, control]: &[&ComparedFrame; 2]| {
            Some(PairPoint {
                seed_structure: biased.place.seed_structure,
                walk: biased.place.walk,
                step: biased.at.1,
                biased: biased.errors.force_mae?,
                control: control.errors.force_mae?,
            })
        };
        Self {
            counts: matched.counts,
            units: units.summary,
            force_mae: quantity(|errors| errors.force_mae),
            mean_force_error: quantity(|errors| errors.mean_force_error),
            energy: quantity(|errors| errors.energy),
            stress: quantity(|errors| errors.stress),
            points: matched.pairs.iter().filter_map(point).collect(),
        }
    }
}

impl PairedQuantity {
    pub(super) fn new(
        matched: &MatchedFrames,
        units: &NumberedUnits,
        of: fn(&FrameErrors) -> Option<f64>,
        bootstrap: Bootstrap,
    ) -> Self {
        let value = |[biased, control]: &[&ComparedFrame; 2]| {
            Some((of(&biased.errors)?, of(&control.errors)?, units.unit(biased.place)))
        };
        let known: Vec<_> = matched.pairs.iter().filter_map(value).collect();
        let columns = [
            sorted_values(known.iter().map(|(biased, _, unit)| (*biased, *unit))),
            sorted_values(known.iter().map(|(_, control, unit)| (*control, *unit))),
            sorted_values(known.iter().map(|(biased, control, unit)| (biased - control, *unit))),
        ];
        let values = |multiplicities: &[u32]| {
            let [biased, control, difference] =
                columns.each_ref().map(|column| median(column, multiplicities));
            vec![biased, control, biased.zip(control).map(|(biased, control)| biased - control), difference]
        };
        let estimates = units.estimates(bootstrap, values, values);
        let range = |side: usize, origin: Origin| {
            let pairs = matched.pairs.iter().map(|pair| pair[side]);
            let frames = pairs.chain(matched.partner_failed[side].iter().copied());
            let mut known: Vec<_> = frames.filter_map(|frame| of(&frame.errors)).collect();
            known.sort_by(f64::total_cmp);
            let failed = matched.failed(origin);
            median_range(&known, failed).filter(|_| failed > 0)
        };
        let differences: Vec<_> = known.iter().map(|(biased, control, _)| biased - control).collect();
        let by_unit = units.summary.resampled.map_or(Vec::new(), |_| medians_by_unit(&known));
        Self {
            pairs: known.len() as u64,
            biased: estimates[0],
            control: estimates[1],
            difference_of_medians: estimates[2],
            median_difference: estimates[3],
            biased_between: range(0, Origin::Biased),
            control_between: range(1, Origin::Control),
            tests: PairedTests::new(&differences),
            tests_by_unit: PairedTests::new(&by_unit),
        }
    }
}

/// The median difference of each unit, from (biased, control, unit).
fn medians_by_unit(known: &[(f64, f64, u32)]) -> Vec<f64> {
    let mut differences: BTreeMap<u32, Vec<f64>> = BTreeMap::new();
    for (biased, control, unit) in known {
        differences.entry(*unit).or_default().push(biased - control);
    }
    let median = |mut of: Vec<f64>| {
        of.sort_by(f64::total_cmp);
        quantile(&of, 0.5)
    };
    differences.into_values().filter_map(median).collect()
}

impl PairedTests {
    fn new(differences: &[f64]) -> Self {
        let (ranks, signs) = (SignedRankTest::new(differences), SignTest::new(differences));
        Self {
            biased_larger: signs.map_or(0, |test| test.positive),
            control_larger: signs.map_or(0, |test| test.negative),
            wilcoxon_p: ranks.map(|test| test.p_value),
            wilcoxon_is_exact: ranks.map(|test| test.is_exact),
            sign_p: signs.map(|test| test.p_value),
        }
    }
}
