mod recorded;

use std::collections::BTreeMap;

use analysis::Bootstrap;
use proptest::prelude::*;
use wire::{ContentHash, Origin};

use super::super::frames::{
    ComparedAtom, ComparedFrame, ComparedFrames, FailedFrame, FrameErrors, FramePlace,
};
use super::units::median_range;
use super::*;

const FEW_DRAWS: Bootstrap = Bootstrap { draws: 200, level: 0.9, seed: 1 };

/// A number between 0 and 1 for each k, each once in 10,007.
fn fraction(k: u64) -> f64 {
    ((k * 7919 + 104_729) % 10_007) as f64 / 10_007.0
}

fn side(origin: Origin) -> u64 {
    u64::from(origin == Origin::Control)
}

/// The atoms of structure `f` of 24: γ, γ_nbr and error.
fn atoms(origin: Origin, f: u64) -> Vec<[f64; 3]> {
    let atom = |a: u64| {
        let k = (24 * side(origin) + f) * 4 + a;
        let gamma = 2.0 * fraction(k + 1);
        let gamma_nbr = 0.8 * gamma + 0.5 * fraction(3 * k + 5);
        let scale = if origin == Origin::Biased { 1.5 } else { 1.0 };
        [gamma, gamma_nbr, gamma_nbr * (0.3 + fraction(7 * k + 11)) * scale]
    };
    (0..4).map(atom).collect()
}

fn content(number: u64) -> ContentHash {
    let mut bytes = [0; 32];
    bytes[..8].copy_from_slice(&number.to_le_bytes());
    ContentHash(bytes)
}

/// Two structures of each walk, at steps 10 and 20, of a seed structure each. Their contents differ, unless they are `shared`.
fn add(frames: &mut ComparedFrames, origin: Origin, f: u64, is_shared: bool) {
    let place = FramePlace { seed_structure: (f / 2) as u32, walk: (f / 2) as u32, origin };
    let step = 10 * (1 + f % 2);
    let atoms = atoms(origin, f);
    if !(is_shared && origin == Origin::Control) {
        for (a, [gamma, gamma_nbr, error]) in atoms.iter().copied().enumerate() {
            let species = ["Al", "O"][a % 2].parse().unwrap();
            frames.atoms.add(ComparedAtom {
                place,
                at: (0, step),
                is_shared,
                species,
                gamma,
                gamma_nbr,
                error,
            });
        }
    }
    let mean = atoms.iter().map(|[_, _, error]| error).sum::<f64>() / 4.0;
    let energy = 0.01 * fraction(11 * (24 * side(origin) + f) + 3);
    let errors = FrameErrors {
        force_mae: Some(0.5 * mean),
        mean_force_error: Some(mean),
        energy: Some(energy),
        stress: None,
    };
    let content = content(if is_shared { f } else { 100 * side(origin) + f });
    let (temperature, relative_volume) = (2000.0 - 500.0 * side(origin) as f64 + f as f64, 1.1);
    let frame = ComparedFrame {
        place,
        at: (0, step),
        content,
        is_shared,
        by_value: false,
        errors,
        temperature,
        relative_volume,
    };
    frames.add_labelled(frame);
}

fn fail(frames: &mut ComparedFrames, origin: Origin, f: u64) {
    let failed = FailedFrame {
        origin,
        walk: (f / 2) as u32,
        step: 10 * (1 + f % 2),
        content: content(1000 + 100 * side(origin) + f),
        is_shared: false,
    };
    frames.add_failed_frame(failed);
}

/// 12 seed structures: 24 structures of either origin. The first is that of both, and two labels failed.
fn campaign() -> ComparedFrames {
    let mut frames = ComparedFrames::new(BTreeMap::new());
    for f in 0..24 {
        for (origin, failed) in [(Origin::Biased, 9), (Origin::Control, 5)] {
            if f == failed { fail(&mut frames, origin, f) } else { add(&mut frames, origin, f, f == 0) }
        }
    }
    frames
}

fn near(found: Option<f64>, expected: f64) {
    assert!(found.is_some_and(|found| (found / expected - 1.0).abs() < 1e-12), "{found:?} is not {expected}");
}

/// Estimates by NumPy and SciPy 1.17 (`numpy.median`, `scipy.stats.wilcoxon(method="exact")`, `binomtest`, `spearmanr`) and
/// scikit-learn (`roc_auc_score`) of the same numbers.
#[test]
fn statistics_are_those_of_scipy() {
    let found = WalkComparison::new(&campaign(), COMPARISON_BOOTSTRAP);
    let PairedErrors { counts, units, force_mae, energy, stress, points, .. } = &found.pairs;
    let expected = PairCounts {
        pairs: 21,
        same_structure: 1,
        biased_failed: 1,
        control_failed: 1,
        ..PairCounts::default()
    };
    assert_eq!(*counts, expected);
    assert_eq!((units.resampled, units.walks, points.len()), (Some(ResampledUnit::SeedStructures), 12, 21));
    near(force_mae.biased.value, 0.6961791908799646);
    near(force_mae.control.value, 0.39631330209604754);
    near(force_mae.difference_of_medians.value, 0.6961791908799646 - 0.39631330209604754);
    near(force_mae.median_difference.value, 0.28005779707452505);
    near(force_mae.tests.wilcoxon_p, 1.33514404296875e-5);
    near(force_mae.tests.sign_p, 0.00022125244140625);
    assert_eq!((force_mae.tests.biased_larger, force_mae.tests.control_larger), (19, 2));
    near(force_mae.tests_by_unit.wilcoxon_p, 0.00048828125);
    assert_eq!((force_mae.tests.wilcoxon_is_exact, force_mae.tests_by_unit.biased_larger), (Some(true), 12));
    // Of the failed biased candidate, the error could be anything; that of its step's partner is known.
    let (low, high) = force_mae.biased_between.unwrap();
    near(Some(low), 0.6361253274401734);
    near(high, 0.6961791908799646);
    near(energy.biased.value, 0.005261317078045368);
    near(energy.control.value, 0.005559108623963226);
    assert_eq!((stress.pairs, stress.biased.value, stress.tests.wilcoxon_p), (0, None, None));

    let (biased, control) = (&found.matched.biased, &found.matched.control);
    assert_eq!((biased.structures, biased.sampled_atoms, biased.failed, control.failed), (21, 84, 1, 1));
    near(biased.median_error.value, 1.106924085837026);
    near(biased.gamma.spearman.value, 0.7408322365090615);
    near(biased.gamma_nbr.spearman.value, 0.7807633896932267);
    let (at_third, at_one) = (9, 12);
    assert_eq!((found.thresholds[at_third], found.thresholds[at_one]), (0.3, 1.0));
    near(biased.gamma.roc_auc[at_third].value, 0.860082304526749);
    near(biased.gamma_nbr.roc_auc[at_one].value, 0.8938775510204082);
    near(control.median_error.value, 0.6871726042394887);
    near(control.gamma.roc_auc[at_one].value, 0.8413559322033899);
    near(control.gamma_nbr.roc_auc[at_one].value, 0.8359322033898304);
    let oxygen = &biased.elements[0];
    assert_eq!((oxygen.element, oxygen.sampled_atoms, biased.elements[1].element), ("O", 42, "Al"));
    near(oxygen.median_error.value, 1.0701338256035804);
    near(oxygen.gamma.spearman.value, 0.7100721173324691);
    near(oxygen.gamma_nbr.roc_auc[0].value, 0.9318181818181819);
    // The structure of both origins counts once in `all`.
    let PooledGroups { all, biased, control } = &found.pooled;
    assert_eq!((all.structures, biased.structures, control.structures, all.sampled_atoms), (45, 22, 22, 180));
    near(all.median_error.value, 0.91082509448842);
    near(all.gamma.spearman.value, 0.6839182279288456);
    near(all.gamma_nbr.roc_auc[at_one].value, 0.83875);
    near(all.elements[0].gamma_nbr.roc_auc[0].value, 0.8987854251012146);
    near(
        found.matched.biased.mean_temperature.zip(found.matched.control.mean_temperature).map(|(a, b)| a - b),
        500.0,
    );
    // A single unit with such errors says nothing about other units.
    let rare = biased.gamma.roc_auc.iter().filter(|area| area.value.is_some() && area.interval.is_none());
    assert!(
        rare.count() > 0
            && all.gamma.roc_auc.iter().all(|area| area.value.is_some() || area.interval.is_none())
    );
    // Intervals are there and hold the estimates of such a sample.
    for estimate in
        [force_mae.biased, all.gamma.spearman, all.gamma_nbr.roc_auc[at_one], oxygen.gamma.spearman]
    {
        let ((low, high), value) = (estimate.interval.unwrap(), estimate.value.unwrap());
        assert!(low < value && value < high, "{estimate:?}");
    }
}

/// A campaign of `walks` walks, each with a pair, of `seed_structures` seed structures.
fn small(seed_structures: u64, walks: u64) -> WalkComparison {
    let mut frames = ComparedFrames::new(BTreeMap::new());
    for f in 0..walks {
        for origin in [Origin::Biased, Origin::Control] {
            add(&mut frames, origin, 2 * f, false);
        }
    }
    let labelled: Vec<_> = frames.labelled().cloned().collect();
    let mut grouped = ComparedFrames::new(BTreeMap::new());
    grouped.atoms = frames.atoms;
    for frame in labelled {
        let place = FramePlace { seed_structure: frame.place.walk % seed_structures as u32, ..frame.place };
        grouped.add_labelled(ComparedFrame { place, ..frame });
    }
    WalkComparison::new(&grouped, FEW_DRAWS)
}

#[test]
fn few_units_have_no_intervals() {
    let pairs = small(3, 12).pairs;
    assert_eq!(
        pairs.units,
        ResamplingUnits { resampled: Some(ResampledUnit::Walks), seed_structures: 3, walks: 12 }
    );
    assert!(pairs.force_mae.biased.interval.is_some() && pairs.force_mae.tests_by_unit.wilcoxon_p.is_some());
    let few = small(3, 9);
    assert_eq!((few.pairs.units.resampled, few.pairs.units.walks), (None, 9));
    let PairedQuantity { biased, tests, tests_by_unit, .. } = &few.pairs.force_mae;
    assert!(biased.value.is_some() && biased.interval.is_none() && tests.wilcoxon_p.is_some());
    assert_eq!(*tests_by_unit, PairedTests::default());
    let without = WalkComparison::new(&ComparedFrames::new(BTreeMap::new()), FEW_DRAWS);
    assert_eq!((without.pairs.counts, without.pooled.all.structures), (PairCounts::default(), 0));
    assert_eq!(without.pooled.all.median_error, ConfidenceEstimate::default());
}

proptest! {
    /// The range of a median holds the median for any errors of what is unknown.
    #[test]
    fn ranges_hold_every_median(
        mut known in prop::collection::vec(0.0..10.0, 1..20), unknown in prop::collection::vec(0.0..1e3, 0..25)
    ) {
        known.sort_by(f64::total_cmp);
        let (low, high) = median_range(&known, unknown.len() as u64).unwrap();
        let mut all: Vec<f64> = known.iter().chain(&unknown).copied().collect();
        all.sort_by(f64::total_cmp);
        let median = analysis::quantile(&all, 0.5).unwrap();
        prop_assert!(low <= median + 1e-12 && high.is_none_or(|high| median <= high + 1e-12), "{low} {median} {high:?}");
        prop_assert_eq!(high.is_none(), unknown.len() >= known.len());
    }
}

/// Independent standard normal numbers, as a function of their place.
fn normal(place: u64) -> f64 {
    let uniform = |k: u64| {
        let hash = blake3::hash(&(2 * place + k).to_le_bytes());
        let bits = u64::from_le_bytes(hash.as_bytes()[..8].try_into().unwrap());
        ((bits >> 11) as f64 + 0.5) / 2_f64.powi(53)
    };
    (-2.0 * uniform(0).ln()).sqrt() * (std::f64::consts::TAU * uniform(1)).cos()
}

/// A standard normal number of an atom, with a half of its variance from its seed structure, and a tenth each from its walk and
/// its structure. `places` are those of all four.
fn nested(places: [u64; 4]) -> f64 {
    let weights = [0.5_f64, 0.1, 0.1, 0.3];
    places.into_iter().zip(weights).map(|(place, weight)| weight.sqrt() * normal(place)).sum()
}

/// A synthetic campaign with a known truth.
#[derive(Clone, Copy)]
struct SyntheticCampaign {
    seed_structures: u64,
    /// Pairs of walks from each seed structure, with a pair of structures each.
    walks: u64,
    /// Biased walks from a seed structure with large errors find three structures each.
    is_adaptive: bool,
    /// Each biased structure has four atoms. ln γ and ln of the error are normal with the correlation ½.
    with_atoms: bool,
}

const PLAIN: SyntheticCampaign =
    SyntheticCampaign { seed_structures: 30, walks: 2, is_adaptive: false, with_atoms: false };

impl SyntheticCampaign {
    /// Force MAE are lognormal with the medians 2 and 1.
    fn frames(self, repetition: u64) -> ComparedFrames {
        let mut frames = ComparedFrames::new(BTreeMap::new());
        for walk in 0..self.seed_structures * self.walks {
            let draws = WalkDraws { repetition, seed: walk / self.walks, walk };
            let is_large = normal(draws.place(0, 0, draws.seed)) > 0.0;
            let found = if self.is_adaptive && is_large { 3 } else { 1 };
            for number in 0..found {
                for origin in [Origin::Biased, Origin::Control] {
                    self.find(&mut frames, draws, origin, number);
                }
            }
        }
        frames
    }

    fn find(self, frames: &mut ComparedFrames, draws: WalkDraws, origin: Origin, number: u64) {
        let WalkDraws { seed, walk, .. } = draws;
        let place = FramePlace { seed_structure: seed as u32, walk: walk as u32, origin };
        let (at, structure) = ((0, 10 + number), 3 * walk + number);
        if self.with_atoms && origin == Origin::Biased {
            for atom in 4 * structure..4 * structure + 4 {
                let (x, e) = (draws.value(2, structure, atom), draws.value(3, structure, atom));
                let (gamma, error) = (x.exp(), (0.5 * x + 0.75_f64.sqrt() * e).exp());
                let species = "Al".parse().unwrap();
                frames.atoms.add(ComparedAtom {
                    place,
                    at,
                    is_shared: false,
                    species,
                    gamma,
                    gamma_nbr: gamma,
                    error,
                });
            }
        }
        let median: f64 = if origin == Origin::Biased { 2.0 } else { 1.0 };
        let force_mae = Some(median * draws.value(side(origin), structure, structure).exp());
        frames.add_labelled(ComparedFrame {
            place,
            at,
            content: content(1000 * side(origin) + structure),
            is_shared: false,
            by_value: false,
            errors: FrameErrors { force_mae, mean_force_error: None, energy: None, stress: None },
            temperature: 300.0,
            relative_volume: 1.0,
        });
    }
}

/// The random numbers of a walk.
#[derive(Clone, Copy)]
struct WalkDraws {
    repetition: u64,
    seed: u64,
    walk: u64,
}

impl WalkDraws {
    /// The place of a number of this kind, of a seed structure, walk, structure or atom (`level`).
    fn place(self, kind: u64, level: u64, number: u64) -> u64 {
        ((self.repetition * 8 + kind) * 4 + level) * 1024 + number
    }

    fn value(self, kind: u64, structure: u64, atom: u64) -> f64 {
        nested([
            self.place(kind, 0, self.seed),
            self.place(kind, 1, self.walk),
            self.place(kind, 2, structure),
            self.place(kind, 3, atom),
        ])
    }
}

/// Share of the repetitions in which each interval holds the truth.
fn coverage<const N: usize>(
    repetitions: u64,
    truth: [f64; N],
    estimates: impl Fn(u64) -> [ConfidenceEstimate; N],
) -> [f64; N] {
    let mut held = [0.0; N];
    for repetition in 0..repetitions {
        for ((held, truth), estimate) in held.iter_mut().zip(truth).zip(estimates(repetition)) {
            let (low, high) = estimate.interval.expect("an interval");
            *held += if low <= truth && truth <= high { 1.0 / repetitions as f64 } else { 0.0 };
        }
    }
    held
}

/// How often intervals of 90 % hold the medians of both sides, of which this is the biased one, and their difference.
fn coverage_of_medians(campaign: SyntheticCampaign, biased: f64) -> [f64; 3] {
    coverage(1000, [biased, 1.0, biased - 1.0], |repetition| {
        let frames = campaign.frames(repetition);
        let bootstrap = Bootstrap { seed: repetition, ..FEW_DRAWS };
        let matched = pairs::match_frames(&frames);
        let units = units::NumberedUnits::new(matched.pairs.iter().map(|[biased, _]| biased.place));
        let force_mae = PairedQuantity::new(&matched, &units, |errors| errors.force_mae, bootstrap);
        [force_mae.biased, force_mae.control, force_mae.difference_of_medians]
    })
}

/// docs/errors.md has these numbers.
#[test]
fn intervals_of_medians_hold_the_truth_as_often_as_they_say() {
    let of = |seed_structures, walks| {
        coverage_of_medians(SyntheticCampaign { seed_structures, walks, ..PLAIN }, 2.0)
    };
    let check = |found: [f64; 3], low: f64, high: f64| {
        println!("{found:?}");
        assert!(found.iter().all(|share| (low..=high).contains(share)), "{found:?}");
    };
    check(of(30, 2), 0.88, 0.92);
    // The fewest seed structures with an interval: on the safe side.
    check(of(10, 2), 0.88, 0.96);
    check(of(10, 1), 0.88, 0.96);
    // By walks, with half of the variance between five seed structures: too narrow, as is said.
    check(of(5, 4), 0.70, 0.85);
}

/// The median of ln(error / 2) in an adaptive collection: the zero of F(x) − ½ with F(x) = (P(X < x, U < 0) + 3 P(X < x, U > 0)) / 2 for the
/// normal X of variance 1 with the part U of variance ½ (`brentq` and `multivariate_normal.cdf` of SciPy).
const ADAPTIVE_MEDIAN: f64 = 0.300_321_385_39;

/// Where the campaign finds large errors it collects more. Its median is then that of what is collected.
#[test]
fn intervals_of_medians_hold_the_truth_of_an_adaptive_collection() {
    let campaign = SyntheticCampaign { is_adaptive: true, ..PLAIN };
    let found = coverage_of_medians(campaign, 2.0 * ADAPTIVE_MEDIAN.exp());
    println!("{found:?}");
    assert!(found.iter().all(|share| (0.88..=0.92).contains(share)), "{found:?}");
}

#[test]
fn intervals_of_rank_statistics_hold_the_truth_as_often_as_they_say() {
    // Of a normal pair with correlation ½: ρ = 6/π asin ¼, and for errors above their median the area ½ + 2/π asin(½/√2).
    let truth = [
        6.0 / std::f64::consts::PI * 0.25_f64.asin(),
        0.5 + 2.0 / std::f64::consts::PI * 0.125_f64.sqrt().asin(),
    ];
    let campaign = SyntheticCampaign { with_atoms: true, ..PLAIN };
    let found = coverage(1000, truth, |repetition| {
        let frames = campaign.frames(repetition);
        let labelled = frames.labelled().filter(|frame| frame.place.origin == Origin::Biased);
        let (labelled, atoms): (Vec<_>, Vec<_>) = (labelled.collect(), frames.atoms.items().collect());
        let group = ComparedGroup::new(&labelled, &atoms, 0, Bootstrap { seed: repetition, ..FEW_DRAWS });
        [group.gamma.spearman, group.gamma.roc_auc[12]]
    });
    // Nominal: 90 %.
    assert!(found.iter().all(|share| (0.88..=0.92).contains(share)), "{found:?}");
}
