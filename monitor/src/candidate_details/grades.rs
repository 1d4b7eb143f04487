//! Grades of a candidate under three mixtures, and the atoms that triggered it.

use calm::CollectionRule;
use calm::rules::count_above;
use serde::Serialize;
use serde_json::Value;
use store::{LoggedDecision, StoredCandidate};
use wire::Origin;

/// Grades of a candidate under three mixtures.
#[derive(Clone, Debug, Serialize)]
pub struct CandidateGrades {
    /// Under the walker's mixture.
    pub walker: GradeSummary,
    /// Under the selector's mixture before the update. For a control frame it decides nothing.
    pub selector: GradeSummary,
    /// Under the original mixture, with which errors are compared.
    pub original: GradeSummary,
    /// Number of versions by which the selector's mixture was newer than the walker's.
    pub staleness: u64,
    /// The rule that made it a candidate. `None` for a control frame, which is collected for its step.
    pub trigger: Option<Trigger>,
    /// Every atom, in the order of the structure.
    pub atoms: Vec<GradedAtom>,
}

/// The grade of a structure under one mixture.
#[derive(Clone, Debug, Serialize)]
pub struct GradeSummary {
    /// Version of the mixture; 0 is the original one.
    pub mixture_version: u64,
    /// Largest γ.
    pub gamma_max: Option<f64>,
    /// Largest γ_nbr.
    pub gamma_nbr_max: Option<f64>,
    /// Atoms with γ > 1.
    pub atoms_above_1: usize,
}

/// A collection rule and its result.
#[derive(Clone, Debug, Serialize)]
pub struct Trigger {
    /// The configured rule.
    pub rule: CollectionRule,
    /// Grade above which an atom counts.
    pub threshold: f64,
    /// Number of atoms that must be above it.
    pub needed: usize,
    /// Number of atoms above it under the walker's mixture.
    pub above_walker: usize,
    /// The same under the selector's mixture.
    pub above_selector: usize,
}

/// Grades of one atom.
#[derive(Clone, Debug, Serialize)]
pub struct GradedAtom {
    /// Its index, from 0.
    pub atom: usize,
    /// Its element.
    pub element: &'static str,
    /// Whether it was above the threshold under the walker's mixture.
    pub triggered: bool,
    /// γ under the walker's mixture.
    pub gamma_walker: f64,
    /// γ under the selector's mixture before the update.
    pub gamma_selector: Option<f64>,
    /// γ under the original mixture.
    pub gamma_original: Option<f64>,
    /// γ_nbr under the walker's mixture.
    pub gamma_nbr_walker: f64,
    /// γ_nbr under the selector's mixture.
    pub gamma_nbr_selector: Option<f64>,
    /// γ_nbr under the original mixture.
    pub gamma_nbr_original: Option<f64>,
}

impl CandidateGrades {
    pub(super) fn new(stored: &StoredCandidate, rules: &Value, decision: &LoggedDecision) -> Self {
        let view = stored.block.view();
        let (selector, original) = (&stored.selector, &stored.original);
        // An accepted candidate is graded before it updates the mixture.
        let decided = &decision.detail["selector"]["mixture_version"];
        let decided = decided.as_u64().unwrap_or(decision.mixture_version);
        let rule = serde_json::from_value::<CollectionRule>(rules["collect"]["criterion"].clone()).ok();
        let rule = rule.filter(|_| view.origin() == Origin::Biased);
        let trigger = rule.map(|rule| Trigger::new(rule, view.gamma, &selector.gamma));
        let threshold = trigger.as_ref().map_or(f64::INFINITY, |trigger| trigger.threshold);
        let species = view.structure().species;
        let atoms = species.iter().enumerate().map(|(atom, species)| GradedAtom {
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
            walker: GradeSummary::new(view.mixture_version(), view.gamma, view.gamma_nbr),
            selector: GradeSummary::new(decided, &selector.gamma, &selector.gamma_nbr),
            original: GradeSummary::new(0, &original.gamma, &original.gamma_nbr),
            staleness: decided.saturating_sub(view.mixture_version()),
            trigger,
            atoms: atoms.collect(),
        }
    }

    /// The atoms that triggered, by decreasing γ under the walker's mixture.
    pub fn triggered(&self) -> Vec<&GradedAtom> {
        let mut atoms: Vec<_> = self.atoms.iter().filter(|atom| atom.triggered).collect();
        atoms.sort_by(|a, b| b.gamma_walker.total_cmp(&a.gamma_walker));
        atoms
    }
}

impl GradeSummary {
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
        let needed = rule.needed_atoms(walker.len());
        let (above_walker, above_selector) =
            (count_above(walker, threshold), count_above(selector, threshold));
        Self { rule, threshold, needed, above_walker, above_selector }
    }
}
