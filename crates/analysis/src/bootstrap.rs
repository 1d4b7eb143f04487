//! Confidence intervals by resampling.

use std::panic::resume_unwind;
use std::thread::{self, available_parallelism};

use crate::normal_tail::two_sided_normal_tail;
use crate::quantiles::quantile;
use crate::random::Draw;

/// Bootstrap over independent units, such as structures: each draw takes as many units as there are, with
/// replacement, and each with all that belongs to it. Atoms of a structure are not independent of each other, so
/// intervals from drawing atoms would be too narrow. The interval is that between two percentiles of the statistic
/// over the draws (Efron & Tibshirani, An Introduction to the Bootstrap (1993), section 13.3).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bootstrap {
    /// Number of draws.
    pub draws: u32,
    /// Nominal coverage of the intervals, between 0 and 1.
    pub level: f64,
    /// Random seed.
    pub seed: u64,
}

impl Bootstrap {
    /// How often each of `units` units is in a draw; a function of random seed, draw and number of units.
    pub fn multiplicities(&self, draw: u32, units: usize) -> Vec<u32> {
        let (draw, mut counts) = (Draw::new(self.seed, draw), vec![0; units]);
        (0..units).for_each(|index| counts[draw.below(index, units)] += 1);
        counts
    }

    /// The same with the percentiles moved outwards for a small number of units: those at Φ(∓√(n/(n − 1)) t) with the quantile t of
    /// Student's distribution with n − 1 degrees of freedom (expanded percentiles: Hesterberg, The American Statistician 69
    /// (2015) 371, section 5.2). Plain percentiles cover too little: a draw of n units has a variance that is smaller by (n − 1)/n, and
    /// they take the place of a normal distribution. `units` must be at least 5, below which the expansion of t has no meaning.
    pub fn expanded(&self, units: usize) -> Self {
        let freedom = units.max(5) as f64 - 1.0;
        let t = student_quantile(normal_quantile(1.0 - self.level), freedom);
        Self { level: 1.0 - two_sided_normal_tail(((freedom + 1.0) / freedom).sqrt() * t), ..*self }
    }

    /// The interval of each of the statistics that `draw` computes from the number of a draw, as [`Self::interval`]. All cores of this
    /// host share the draws; the result does not depend on their number.
    pub fn intervals(&self, draw: impl Fn(u32) -> Vec<Option<f64>> + Sync) -> Vec<Option<(f64, f64)>> {
        let threads = available_parallelism().map_or(1, |cores| cores.get()).min(self.draws as usize).max(1);
        let share = |first: usize| -> Vec<Vec<Option<f64>>> {
            (first..self.draws as usize).step_by(threads).map(|number| draw(number as u32)).collect()
        };
        let share = &share;
        // The order of the draws has no meaning.
        let draws: Vec<Vec<Option<f64>>> = thread::scope(|scope| {
            let threads: Vec<_> = (0..threads).map(|first| scope.spawn(move || share(first))).collect();
            let results = threads.into_iter().map(|thread| thread.join());
            results.flat_map(|draws| draws.unwrap_or_else(|panic| resume_unwind(panic))).collect()
        });
        let number = draws.first().map_or(0, Vec::len);
        let interval = |k| self.interval(&draws.iter().map(|values| values[k]).collect::<Vec<_>>());
        (0..number).map(interval).collect()
    }

    /// The interval from the statistic's values over all draws, each `None` where the statistic is not defined.
    /// `None` if it is defined in no more than half of them.
    pub fn interval(&self, values: &[Option<f64>]) -> Option<(f64, f64)> {
        let mut known: Vec<_> = values.iter().flatten().copied().collect();
        if 2 * known.len() <= values.len() {
            return None;
        }
        known.sort_by(f64::total_cmp);
        let tail = 0.5 * (1.0 - self.level);
        quantile(&known, tail).zip(quantile(&known, 1.0 - tail))
    }
}

/// The z with P(|Z| ≥ z) = `tail` of a standard normal Z, for tails above 10⁻²⁰.
fn normal_quantile(tail: f64) -> f64 {
    let (mut low, mut high) = (0.0, 10.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if two_sided_normal_tail(middle) > tail { low = middle } else { high = middle }
    }
    low
}

/// The quantile of Student's distribution where the normal distribution has `x` (Abramowitz & Stegun 26.7.5).
fn student_quantile(x: f64, freedom: f64) -> f64 {
    let terms = [
        (x.powi(3) + x) / 4.0,
        (5.0 * x.powi(5) + 16.0 * x.powi(3) + 3.0 * x) / 96.0,
        (3.0 * x.powi(7) + 19.0 * x.powi(5) + 17.0 * x.powi(3) - 15.0 * x) / 384.0,
        (79.0 * x.powi(9) + 776.0 * x.powi(7) + 1482.0 * x.powi(5) - 1920.0 * x.powi(3) - 945.0 * x)
            / 92160.0,
    ];
    terms.iter().rev().fold(0.0, |sum, term| (sum + term) / freedom) + x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RankedErrors;

    const NINETY: Bootstrap = Bootstrap { draws: 100, level: 0.9, seed: 1 };

    #[test]
    fn units_are_drawn_with_replacement() {
        let units = 500;
        let draws: Vec<_> = (0..20).map(|draw| NINETY.multiplicities(draw, units)).collect();
        assert!(draws.iter().all(|counts| counts.iter().sum::<u32>() == units as u32));
        assert!(draws[0] != draws[1] && draws[0] == NINETY.multiplicities(0, units));
        // A unit is in no draw with probability (1 − 1/n)ⁿ ≈ 1/e.
        let absent = draws.iter().flatten().filter(|count| **count == 0).count() as f64 / 1e4;
        assert!((absent - (-1.0_f64).exp()).abs() < 0.02, "{absent}");
        assert!(NINETY.multiplicities(0, 0).is_empty());
    }

    #[test]
    fn intervals_are_percentiles_of_the_draws() {
        let values: Vec<_> = (0..=100).rev().map(|k| Some(f64::from(k))).collect();
        let (low, high) = NINETY.interval(&values).unwrap();
        assert!((low - 5.0).abs() < 1e-9 && (high - 95.0).abs() < 1e-9);
        assert_eq!(NINETY.interval(&[Some(1.0), None]), None);
        assert_eq!(NINETY.interval(&[Some(1.0), Some(1.0), None]), Some((1.0, 1.0)));
        assert_eq!(NINETY.interval(&[]), None);
    }

    #[test]
    fn intervals_are_those_of_each_statistic() {
        let values =
            |draw: u32| vec![Some(f64::from(draw)), draw.is_multiple_of(4).then_some(1.0), Some(7.0)];
        let first: Vec<_> = (0..NINETY.draws).map(|draw| Some(f64::from(draw))).collect();
        let expected = [NINETY.interval(&first), None, Some((7.0, 7.0))];
        assert_eq!(NINETY.intervals(values), expected);
        assert!(Bootstrap { draws: 0, ..NINETY }.intervals(values).is_empty());
    }

    /// 1 - 2 * norm.cdf(-sqrt(n / (n - 1)) * t.ppf(0.5 + level / 2, n - 1)), SciPy 1.17.
    #[test]
    fn few_units_take_wider_percentiles() {
        for (units, level, expected) in [
            (10, 0.9, 0.946_673_9),
            (10, 0.95, 0.982_898_7),
            (12, 0.95, 0.978_486_8),
            (40, 0.9, 0.912_055_1),
            (1000, 0.95, 0.950_391_4),
        ] {
            let found = Bootstrap { level, ..NINETY }.expanded(units).level;
            assert!((found - expected).abs() < 1e-6, "{units} {level}: {found}");
        }
    }

    /// Two standard normal numbers.
    fn normals(place: usize) -> [f64; 2] {
        let uniform = |index| (Draw::new(99, place as u32).below(index, 1 << 53) + 1) as f64 / 2_f64.powi(53);
        let (sin, cos) = (std::f64::consts::TAU * uniform(1)).sin_cos();
        let radius = (-2.0 * uniform(0).ln()).sqrt();
        [radius * cos, radius * sin]
    }

    /// Share of 300 samples whose 90 % interval of Spearman's ρ holds the true one. A sample has 40 structures of 6 atoms,
    /// whose grades and errors are normal with correlation ½, and which share most of their variance with those of their
    /// structure. `unit` says what is drawn.
    fn coverage(unit: fn(usize) -> u32, units: usize) -> f64 {
        let truth = 6.0 / std::f64::consts::PI * 0.25_f64.asin();
        let holds = |sample: usize| {
            let pair = |place: usize| normals(1000 * sample + place);
            let atom = |k: usize| {
                let ([a, b], [c, d]) = (pair(k / 6), pair(500 + k));
                let (x, y) = (0.8 * a + 0.6 * c, 0.8 * b + 0.6 * d);
                [x, 0.5 * x + 0.75_f64.sqrt() * y]
            };
            let atoms: Vec<_> = (0..240).map(atom).collect();
            let column = |k: usize| atoms.iter().map(|atom| atom[k]).collect::<Vec<_>>();
            let of_atoms: Vec<_> = (0..240).map(unit).collect();
            let ranked = RankedErrors::new(&column(1), &of_atoms, &[column(0)]);
            let bootstrap = Bootstrap { seed: sample as u64, ..NINETY };
            let rho = |draw| ranked.statistics(&bootstrap.multiplicities(draw, units), &[])[0].spearman;
            let (low, high) = bootstrap.interval(&(0..bootstrap.draws).map(rho).collect::<Vec<_>>()).unwrap();
            low <= truth && truth <= high
        };
        (0..300).filter(|sample| holds(*sample)).count() as f64 / 300.0
    }

    #[test]
    fn an_interval_covers_the_truth_as_often_as_it_says() {
        let structures = coverage(|atom| atom as u32 / 6, 40);
        // Three standard deviations, √(0.9 · 0.1 / 300) each.
        assert!((structures - 0.9).abs() < 3.0 * 0.0173, "{structures}");
        let atoms = coverage(|atom| atom as u32, 240);
        assert!(atoms < 0.75, "{atoms}");
    }
}
