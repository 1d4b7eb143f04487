//! Mean errors over structures.

use analysis::{EnergyOffsets, LabelledEnergy};

use super::super::collect::SampledStructure;
use super::super::deviations::Deviations;
use super::super::report::Offset;
use super::StatisticValues;

/// Structures that must support an offset before it is removed.
const MIN_SUPPORT: f64 = 2.0;

/// Errors of the sampled structures: energy with and without offsets, forces, stress.
pub struct StructureStatistics {
    deviations: Vec<[Deviations; 4]>,
    offsets: Option<EnergyOffsets>,
}

impl StructureStatistics {
    pub fn new(sample: &[&SampledStructure]) -> Self {
        let energies: Vec<_> = sample.iter().filter_map(|structure| structure.energies.clone()).collect();
        let offsets = EnergyOffsets::fit(&energies).ok();
        let without = |energies: &LabelledEnergy| offsets.as_ref()?.error_per_atom(energies, MIN_SUPPORT);
        let deviations = |structure: &SampledStructure| {
            let mut energy = Deviations::default();
            structure.energies.as_ref().and_then(without).into_iter().for_each(|error| energy.add(error));
            [structure.energy, energy, structure.forces, structure.stress]
        };
        Self { deviations: sample.iter().map(|structure| deviations(structure)).collect(), offsets }
    }

    pub fn len(&self) -> usize {
        self.deviations.len()
    }

    /// Absolute error of the energy per atom without the offsets of elements, eV, of each structure. `None` without an energy, or if too
    /// few structures support the offset of its composition.
    pub fn energy_errors(&self) -> Vec<Option<f64>> {
        self.deviations.iter().map(|[_, energy, ..]| energy.mean_absolute()).collect()
    }

    pub fn offsets(&self) -> Vec<Offset> {
        self.offsets.iter().flat_map(EnergyOffsets::elements).map(Into::into).collect()
    }

    /// Sums over all structures, each as often as its multiplicity.
    pub fn sums(&self, multiplicities: &[u32]) -> [Deviations; 4] {
        let mut sums = [Deviations::default(); 4];
        for (of, times) in self.deviations.iter().zip(multiplicities) {
            sums.iter_mut().zip(of).for_each(|(sum, of)| sum.merge(of, *times));
        }
        sums
    }

    /// Mean absolute and root mean square error of each quantity.
    pub fn values(&self, multiplicities: &[u32]) -> StatisticValues {
        let sums = self.sums(multiplicities);
        sums.iter().flat_map(|sum| [sum.mean_absolute(), sum.root_mean_square()]).collect()
    }
}
