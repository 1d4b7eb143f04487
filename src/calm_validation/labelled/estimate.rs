//! The report of what was collected.

mod atoms;
mod bins;
mod compositions;
mod structures;

use analysis::{Bootstrap, ERROR_THRESHOLDS};

use self::atoms::AtomStatistics;
use self::structures::StructureStatistics;
use super::collect::{LabelledErrors, SampledAtom, SampledStructure};
use super::report::{
    BootstrapSettings, Confident, ElementAuc, IntervalEstimate, LabelledReport, ScoreReport,
};
use super::report::{ErrorHistograms, MeanErrors, TrainingErrors};

/// Intervals that hold the true value with a probability of 95 %.
pub const BOOTSTRAP: Bootstrap = Bootstrap { draws: 1000, level: 0.95, seed: 1 };

/// One value of each statistic, `None` where it is not defined.
type StatisticValues = Vec<Option<f64>>;

/// A structure with the absolute error of its energy per atom without the offsets of elements, eV; `None` where that is not known.
type StructureEnergyError<'a> = (&'a SampledStructure, Option<f64>);

impl LabelledErrors {
    /// The report. The intervals cost about 40 ns for each draw, sampled atom and score, on all cores: some 15 seconds of one core
    /// for 200,000 atoms and two scores, and little for small sets. Those of the bins take one more pass over the sampled atoms for
    /// each draw and score with a limit.
    pub fn report(&self, bootstrap: Bootstrap) -> LabelledReport {
        let sampled_structures: Vec<_> = self.sample.items().collect();
        let structures = StructureStatistics::new(&sampled_structures);
        let [energy, energy_without_offsets, forces, stress] = self.mean_errors(&structures, bootstrap);
        let energies = structures.energy_errors();
        let of_structures: Vec<_> = sampled_structures.iter().copied().zip(energies).collect();
        let sampled: Vec<_> = self.atoms.items().collect();
        let atoms = AtomStatistics::new(&sampled, &self.columns);
        LabelledReport {
            structures: self.structures,
            atoms: self.atoms.total(),
            left_out: self.left_out,
            sampled_atoms: sampled.len(),
            sampled_structures: atoms.structures,
            bootstrap: BootstrapSettings {
                draws: bootstrap.draws,
                level: bootstrap.level,
                seed: bootstrap.seed,
            },
            energy,
            energy_without_offsets,
            offsets: structures.offsets(),
            forces,
            stress,
            thresholds: ERROR_THRESHOLDS.to_vec(),
            unfiltered: self
                .exceedance
                .first()
                .map_or(vec![None; ERROR_THRESHOLDS.len()], |found| found.unfiltered()),
            scores: self.scores((&sampled, &of_structures), &atoms, bootstrap),
            elements: compositions::by_element(&sampled, &self.columns),
            compositions: compositions::by_composition(&sampled, &of_structures, &self.columns),
        }
    }

    /// The mean errors alone, of the sample; `None` without labels.
    pub fn training_errors(&self) -> Option<TrainingErrors> {
        let sampled: Vec<_> = self.sample.items().collect();
        let structures = StructureStatistics::new(&sampled);
        let [_, energy, ..] = structures.sums(&vec![1; structures.len()]);
        let errors: Vec<f64> = self.atoms.items().map(|atom| atom.error).collect();
        let force = (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64);
        (self.structures > 0).then(|| TrainingErrors { energy: energy.mean_absolute(), force })
    }

    /// Of energy with and without offsets, forces and stress. Those of energies without offsets are of the sample only.
    fn mean_errors(&self, structures: &StructureStatistics, bootstrap: Bootstrap) -> [MeanErrors; 4] {
        let draw = |draw| structures.values(&bootstrap.multiplicities(draw, structures.len()));
        let intervals = bootstrap.intervals(draw);
        let whole = structures.sums(&vec![1; structures.len()]);
        let exact = [self.energy, whole[1], self.forces, self.stress];
        std::array::from_fn(|k| {
            let (of, intervals) = (exact[k], &intervals[2 * k..]);
            MeanErrors {
                number: of.number,
                mean_absolute: IntervalEstimate { value: of.mean_absolute(), interval: intervals[0] },
                root_mean_square: IntervalEstimate { value: of.root_mean_square(), interval: intervals[1] },
            }
        })
    }

    fn scores(
        &self,
        (sampled, structures): (&[&SampledAtom], &[StructureEnergyError]),
        atoms: &AtomStatistics,
        bootstrap: Bootstrap,
    ) -> Vec<ScoreReport> {
        let intervals =
            bootstrap.intervals(|draw| atoms.values(&bootstrap.multiplicities(draw, atoms.structures)));
        let values = atoms.values(&vec![1; atoms.structures]);
        let estimates =
            values.into_iter().zip(intervals).map(|(value, interval)| IntervalEstimate { value, interval });
        let estimates: Vec<_> = estimates.collect();
        let of_columns = estimates.chunks(atoms.values_of_column());
        self.columns
            .iter()
            .zip(of_columns)
            .enumerate()
            .map(|(k, (column, estimates))| {
                let mut next = estimates.iter().copied();
                let mut take =
                    |number: usize| -> Vec<IntervalEstimate> { next.by_ref().take(number).collect() };
                let [spearman, worst_decile, retention] = std::array::from_fn(|_| take(1)[0]);
                let (auc, contamination) = (take(ERROR_THRESHOLDS.len()), take(ERROR_THRESHOLDS.len()));
                let worst_decile_by_element = atoms.elements().zip(take(usize::MAX));
                let element =
                    |((element, atoms, threshold), auc)| ElementAuc { element, atoms, threshold, auc };
                ScoreReport {
                    name: column.name.clone(),
                    limit: column.limit,
                    spearman,
                    energy_spearman: compositions::energy_rank(structures, k),
                    auc,
                    worst_decile,
                    worst_decile_by_element: worst_decile_by_element.map(element).collect(),
                    confident: column.limit.map(|_| self.confident(k, retention, contamination)),
                    bins: self.bins[k]
                        .as_ref()
                        .map_or(Vec::new(), |errors| bins::with_intervals(errors, sampled, k, bootstrap)),
                    bands: atoms::bands(sampled, k, column.limit),
                    error_histograms: column
                        .limit
                        .and_then(|limit| ErrorHistograms::of_atoms(sampled, k, limit)),
                    component_histograms: column
                        .limit
                        .and_then(|limit| ErrorHistograms::of_components(sampled, k, limit)),
                }
            })
            .collect()
    }

    /// Exact values with the intervals of these estimates.
    fn confident(
        &self,
        column: usize,
        retention: IntervalEstimate,
        contamination: Vec<IntervalEstimate>,
    ) -> Confident {
        let found = &self.exceedance[column];
        let exact = found.contamination().into_iter().zip(contamination);
        Confident {
            retention: IntervalEstimate { value: found.retention(), ..retention },
            contamination: exact.map(|(value, estimate)| IntervalEstimate { value, ..estimate }).collect(),
        }
    }
}
