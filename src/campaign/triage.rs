//! What there is to know about each seed structure before its walks start.

use std::collections::BTreeSet;
use std::sync::Arc;

use atoms::units::GPA_PER_EV_A3;
use atoms::{ElementPair, NeighbourList, Species, Structure};
use calm::rules::count_above;
use calm::{Grades, Mixture};
use potentials::grace::Threads;
use potentials::{PotentialWithFeatures, Zbl};
use wire::WalkConditions;
use workers::bias::BiasedPotential;

use super::{LoadedCampaign, SourcedStructure};
use crate::all_cores;

/// What is noteworthy about a seed structure; the worst comes first.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Remark {
    /// It cannot be graded, and why.
    Ungraded(String),
    /// The mixture has no data of these elements.
    NotInMixture(BTreeSet<Species>),
    /// Walks with a bias on the cell cannot start from it without `walk.cell_bias.stress_scale`, and why.
    UnstableCell(String),
    /// It meets the collection rule before its walks start.
    Candidate,
    /// Nothing.
    Nothing,
}

/// The shortest distance of a pair of elements.
#[derive(Clone, Copy, Debug)]
pub struct ShortestPairDistance {
    /// The elements.
    pub pair: ElementPair,
    /// Å.
    pub distance: f64,
    /// The shortest distance that `guard.min_distances` allows in walks from this seed structure, Å.
    pub limit: f64,
}

/// A seed structure under the original mixture.
pub struct SeedStructureTriage<'a> {
    /// The structure.
    pub seed_structure: &'a SourcedStructure,
    /// All pairs of its elements with neighbours, those closest to their limits first.
    pub pairs: Vec<ShortestPairDistance>,
    /// Its largest grade; `None` if it cannot be graded.
    pub gamma_max: Option<f64>,
    /// Number of its atoms above the threshold of the collection rule.
    pub atoms_above: usize,
    /// Number that the collection rule requires.
    pub needed_atoms: usize,
    /// What is noteworthy.
    pub remark: Remark,
}

/// Grades every seed structure of a campaign, on all cores. The worst structures come first: by their remark, then by
/// γ_max. Calls `on_graded` after each.
pub fn triage(campaign: &LoadedCampaign, on_graded: impl Fn() + Sync) -> Vec<SeedStructureTriage<'_>> {
    let examiner = || Examiner::new(campaign);
    let mut all = all_cores::map(campaign.seed_structures.iter(), examiner, |examiner, seed_structure| {
        let found = examiner.examine(seed_structure);
        on_graded();
        found
    });
    let grade = |found: &SeedStructureTriage<'_>| found.gamma_max.unwrap_or(f64::INFINITY);
    all.sort_by(|a, b| a.remark.cmp(&b.remark).then_with(|| grade(b).total_cmp(&grade(a))));
    all
}

/// Examines one seed structure after another.
struct Examiner<'a> {
    campaign: &'a LoadedCampaign,
    potential: Box<dyn PotentialWithFeatures>,
    neighbours: NeighbourList,
    grades: Grades,
}

impl<'a> Examiner<'a> {
    fn new(campaign: &'a LoadedCampaign) -> Self {
        let model = campaign.model.shared();
        let neighbours = NeighbourList::new(model.cutoff(), 0.0);
        let potential = model.evaluator(Threads::default());
        Self { campaign, potential, neighbours, grades: Grades::default() }
    }

    fn examine(&mut self, seed_structure: &'a SourcedStructure) -> SeedStructureTriage<'a> {
        let rule = &self.campaign.config.collect.criterion;
        let structure = &seed_structure.plan.structure;
        let graded = self.grade(structure);
        let gamma = self.grades.gamma.as_slice();
        let missing = not_in_mixture(self.campaign, structure);
        let remark = match &graded {
            Err(error) => Remark::Ungraded(error.clone()),
            Ok(()) if !missing.is_empty() => Remark::NotInMixture(missing),
            Ok(()) => match self.unstable_cell(seed_structure) {
                Some(reason) => Remark::UnstableCell(reason),
                None if rule.is_met(gamma) => Remark::Candidate,
                None => Remark::Nothing,
            },
        };
        SeedStructureTriage {
            seed_structure,
            pairs: self.pairs(seed_structure),
            gamma_max: graded.is_ok().then(|| self.grades.maximum()),
            atoms_above: if graded.is_ok() { count_above(gamma, rule.threshold()) } else { 0 },
            needed_atoms: rule.needed_atoms(structure.len()),
            remark,
        }
    }

    /// Why walks with a bias on the cell cannot start: there is no stress scale, and the bulk modulus in its place is not positive.
    fn unstable_cell(&self, SourcedStructure { plan, .. }: &SourcedStructure) -> Option<String> {
        let settings = self.campaign.walk_settings();
        let is_biased =
            |walk: &WalkConditions| walk.constant_pressure().is_some_and(|constant| constant.cell_bias);
        if settings.cell_bias.stress_scale.is_some() || !plan.walks.iter().any(is_biased) {
            return None;
        }
        // The potential of the walks, the bias off.
        let species = &plan.structure.species;
        let zbl = settings.zbl.as_ref().map(|windows| Zbl::new(species, windows)).transpose().ok()?;
        let evaluator = self.campaign.model.shared().evaluator(Threads::default());
        let mixture = Arc::new(self.campaign.artifact.mixture.clone());
        let mut potential = BiasedPotential::new(evaluator, mixture, zbl, 1, species).ok()?;
        match md::bulk_modulus(&plan.structure, &mut potential) {
            Ok(modulus) if modulus > 0.0 => None,
            Ok(modulus) => Some(format!("its bulk modulus is {:.1} GPa", modulus * GPA_PER_EV_A3)),
            Err(error) => Some(error.to_string()),
        }
    }

    fn grade(&mut self, structure: &Structure) -> Result<(), String> {
        let Self { campaign, potential, neighbours, grades } = self;
        let elements =
            potential.model().element_indices(&structure.species).map_err(|error| error.to_string())?;
        neighbours.update(structure).map_err(|error| error.to_string())?;
        potential.forward(structure, neighbours).map_err(|error| error.to_string())?;
        grades
            .evaluate(&campaign.artifact.mixture, &elements, potential.features(), None)
            .map_err(|error| error.to_string())
    }

    fn pairs(&self, SourcedStructure { geometry, .. }: &SourcedStructure) -> Vec<ShortestPairDistance> {
        let limits = self.campaign.config.guard.min_distances.limits(&geometry.shortest);
        let distances = geometry.shortest.iter().zip(limits.iter());
        let pairs =
            distances.map(|((pair, distance), (_, limit))| ShortestPairDistance { pair, distance, limit });
        let mut pairs: Vec<_> = pairs.filter(|pair| pair.distance.is_finite()).collect();
        pairs.sort_by(|a, b| a.relative().total_cmp(&b.relative()));
        pairs
    }
}

impl ShortestPairDistance {
    /// The distance divided by its limit.
    pub fn relative(&self) -> f64 {
        self.distance / self.limit
    }
}

/// The elements of a structure of which the original mixture has no data.
fn not_in_mixture(campaign: &LoadedCampaign, structure: &Structure) -> BTreeSet<Species> {
    let (elements, mixture): (_, &Mixture) = (campaign.model.elements(), &campaign.artifact.mixture);
    let species: BTreeSet<_> = structure.species.iter().copied().collect();
    let has_data = |species: &Species| {
        elements.iter().position(|element| element == species).is_some_and(|index| mixture.has_data_of(index))
    };
    species.into_iter().filter(|species| !has_data(species)).collect()
}
