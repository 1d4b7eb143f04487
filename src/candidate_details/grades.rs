//! The grades of a candidate under three mixtures, and which of its atoms made it one.

use calm::CollectionRule;
use calm::rules::{atom_limit, count_above};
use serde::Serialize;
use serde_json::Value;
use store::{LoggedDecision, StoredCandidate};
use wire::Origin;

/// What was known of it under each mixture.
#[derive(Clone, Debug, Serialize)]
pub struct CandidateGrades {
    /// Under the mixture that the walker saw.
    pub walker: Grade,
    /// Under the selector's, before the update; that of a control's frame decides nothing.
    pub selector: Grade,
    /// Under the original one: what errors are compared with.
    pub original: Grade,
    /// By how many versions the selector's was newer than the walker's.
    pub staleness: u64,
    /// By which rule it became a candidate; none of a control's frame, which was wanted for its step.
    pub trigger: Option<Trigger>,
    /// Every atom, in the order of the structure.
    pub atoms: Vec<Atom>,
}

/// The grade of a structure under one mixture.
#[derive(Clone, Debug, Serialize)]
pub struct Grade {
    /// Version of the mixture; 0 is the original one.
    pub mixture_version: u64,
    /// Largest γ.
    pub gamma_max: Option<f64>,
    /// Largest γ_nbr.
    pub gamma_nbr_max: Option<f64>,
    /// Atoms with γ > 1.
    pub atoms_above_1: usize,
}

/// A collection rule and what it found.
#[derive(Clone, Debug, Serialize)]
pub struct Trigger {
    /// The rule, as configured.
    pub rule: CollectionRule,
    /// Grade above which an atom counts.
    pub threshold: f64,
    /// As many atoms as must lie above it.
    pub needed: usize,
    /// As many did under the walker's mixture.
    pub above_walker: usize,
    /// And under the selector's.
    pub above_selector: usize,
}

/// Grades of one atom.
#[derive(Clone, Debug, Serialize)]
pub struct Atom {
    /// Its index, from 0.
    pub atom: usize,
    /// Its element.
    pub element: &'static str,
    /// Whether it lay above the threshold under the walker's mixture.
    pub triggered: bool,
    /// γ under the walker's mixture.
    pub gamma_walker: f64,
    /// γ under the selector's, before the update.
    pub gamma_selector: Option<f64>,
    /// γ under the original one.
    pub gamma_original: Option<f64>,
    /// γ_nbr under the walker's mixture.
    pub gamma_nbr_walker: f64,
    /// γ_nbr under the selector's.
    pub gamma_nbr_selector: Option<f64>,
    /// γ_nbr under the original one.
    pub gamma_nbr_original: Option<f64>,
}

impl CandidateGrades {
    pub(super) fn new(stored: &StoredCandidate, rules: &Value, decision: &LoggedDecision) -> Self {
        let view = stored.block.view();
        let (selector, original) = (&stored.selector, &stored.original);
        // The update that an accepted candidate causes comes after its grade.
        let decided = &decision.detail["selector"]["mixture_version"];
        let decided = decided.as_u64().unwrap_or(decision.mixture_version);
        let rule = serde_json::from_value::<CollectionRule>(rules["collect"]["when"].clone()).ok();
        let rule = rule.filter(|_| view.origin() == Origin::Biased);
        let trigger = rule.map(|rule| Trigger::new(rule, view.gamma, &selector.gamma));
        let threshold = trigger.as_ref().map_or(f64::INFINITY, |trigger| trigger.threshold);
        let species = view.structure().species;
        let atoms = species.iter().enumerate().map(|(atom, species)| Atom {
            atom,
            element: species.symbol(),
            triggered: view.gamma[atom] > threshold,
            gamma_walker: view.gamma[atom],
            gamma_selector: selector.gamma.get(atom).copied(),
            gamma_original: original.gamma.get(atom).copied(),
            gamma_nbr_walker: view.gamma_nbr[atom],
            gamma_nbr_selector: selector.gamma_nbr.get(atom).copied(),
            gamma_nbr_original: original.gamma_nbr.get(atom).copied(),
        });
        Self {
            walker: Grade::new(view.mixture_version(), view.gamma, view.gamma_nbr),
            selector: Grade::new(decided, &selector.gamma, &selector.gamma_nbr),
            original: Grade::new(0, &original.gamma, &original.gamma_nbr),
            staleness: decided.saturating_sub(view.mixture_version()),
            trigger,
            atoms: atoms.collect(),
        }
    }

    /// The atoms that triggered, the largest γ under the walker's mixture first.
    pub fn triggered(&self) -> Vec<&Atom> {
        let mut atoms: Vec<_> = self.atoms.iter().filter(|atom| atom.triggered).collect();
        atoms.sort_by(|a, b| b.gamma_walker.total_cmp(&a.gamma_walker));
        atoms
    }
}

impl Grade {
    fn new(mixture_version: u64, gamma: &[f64], gamma_nbr: &[f64]) -> Self {
        let largest = |grades: &[f64]| grades.iter().copied().reduce(f64::max);
        Self {
            mixture_version,
            gamma_max: largest(gamma),
            gamma_nbr_max: largest(gamma_nbr),
            atoms_above_1: count_above(gamma, 1.0),
        }
    }
}

impl Trigger {
    fn new(rule: CollectionRule, walker: &[f64], selector: &[f64]) -> Self {
        let threshold = rule.threshold();
        let needed = match rule {
            CollectionRule::MaximumGrade { .. } => 1,
            CollectionRule::AtomCount { fraction, least, .. } => atom_limit(walker.len(), fraction, least),
        };
        let (above_walker, above_selector) =
            (count_above(walker, threshold), count_above(selector, threshold));
        Self { rule, threshold, needed, above_walker, above_selector }
    }
}
