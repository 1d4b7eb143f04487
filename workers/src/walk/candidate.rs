//! Builds a candidate with all its data.

use atoms::NeighbourList;
use calm::neighbourhood::{Pair, neighbourhood_average};
use wire::{Candidate, CandidateId, ContentHash};

use super::{RunningWalk, WalkError, gamma};

impl RunningWalk<'_> {
    /// The current state as a candidate.
    pub(super) fn candidate(&mut self) -> Result<Candidate, WalkError> {
        let gamma = gamma(&mut self.potential, &self.dynamics)?.to_vec();
        let structure = self.dynamics.structure().clone();
        let pairs = self.pairs(self.dynamics.neighbours());
        let gamma_nbr = neighbourhood_average(&gamma, pairs).expect("pairs of these very atoms");
        self.separate_bias()?;
        let physical = self.potential.physical();
        let id = CandidateId {
            campaign: self.assignment.campaign,
            walk: self.assignment.walk,
            segment: self.state.segment,
            step: self.step(),
            content: ContentHash::from_structure(&structure),
        };
        Ok(Candidate {
            id,
            origin: self.assignment.origin,
            mixture_version: self.mixture_version,
            temperature: self.dynamics.temperature(),
            relative_volume: self.relative_volume(),
            energy: physical.energy(),
            virial: physical.virial,
            structure,
            forces: physical.forces.clone(),
            gamma,
            gamma_nbr,
            features: self.potential.features().to_vec(),
        })
    }

    /// Directed pairs within their cutoffs, for γ_nbr.
    fn pairs(&self, neighbours: &NeighbourList) -> Vec<Pair> {
        let (structure, elements) = (self.dynamics.structure(), self.potential.elements());
        let (mut pairs, mut bonds) = (Vec::new(), Vec::new());
        for i in 0..structure.len() {
            neighbours.bonds_within(structure, i, self.model.cutoff(), &mut bonds);
            pairs.extend(bonds.iter().map(|bond| {
                let j = bond.atom as usize;
                Pair::new(i, j, bond.r, self.model.pair_cutoff(elements[i], elements[j]))
            }));
        }
        pairs
    }
}
