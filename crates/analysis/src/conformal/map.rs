//! Bounds by the grade of an atom, by group where the data suffice.

use std::collections::BTreeMap;

use super::{ConformalSettings, ConformalWindow};
use crate::Bins;

/// An atom with its grade, the size of its error and its group, such as its element.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GradedError<G> {
    /// The grade.
    pub grade: f64,
    /// The error.
    pub error: f64,
    /// The group.
    pub group: G,
}

/// How often bounds held for the newest structures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RollingCoverage {
    /// Mean share of a structure's atoms with a bound whose error was not above it.
    pub share: f64,
    /// Number of structures with a bound for any of their atoms.
    pub structures: usize,
    /// Mean share of a structure's atoms without a bound, over all structures since the oldest of these.
    pub unbounded: f64,
}

/// What a structure told of the bounds from before it came.
#[derive(Clone, Copy, Debug)]
struct StructureOutcome {
    /// Share of its atoms with a bound whose error was not above it; `None` if none had one.
    held: Option<f64>,
    /// Share of its atoms without a bound.
    unbounded: f64,
}

/// A bound of the error for each bin of the grade. A group has bounds of its own in the bins where it has enough structures, and
/// elsewhere those of all atoms.
#[derive(Clone, Debug)]
pub struct ConformalMap<G> {
    settings: ConformalSettings,
    bins: Bins,
    /// By group (`None`: all atoms) and bin.
    windows: BTreeMap<(Option<G>, usize), ConformalWindow>,
    /// Of each structure, from the first with a bound on.
    outcomes: Vec<StructureOutcome>,
    structures: u64,
}

impl<G: Ord + Clone> ConformalMap<G> {
    /// A map without data.
    pub fn new(bins: Bins, settings: ConformalSettings) -> Self {
        Self { settings, bins, windows: BTreeMap::new(), outcomes: Vec::new(), structures: 0 }
    }

    /// What the map promises.
    pub fn settings(&self) -> ConformalSettings {
        self.settings
    }

    /// The bins of the grade.
    pub fn bins(&self) -> &Bins {
        &self.bins
    }

    /// Number of structures that were added.
    pub fn structures(&self) -> u64 {
        self.structures
    }

    /// The bound of the error of an atom with this grade. `None` with too few structures in its bin, while their level in force is
    /// above what they support, and for a grade that is not finite.
    pub fn bound(&self, grade: f64, group: Option<&G>) -> Option<f64> {
        self.sufficient(grade, group)?.bound()
    }

    /// The errors of all atoms in a bin. `None` with too few structures.
    pub fn window(&self, bin: usize) -> Option<&ConformalWindow> {
        self.windows.get(&(None, bin)).filter(|window| window.is_sufficient())
    }

    /// Compares the next structure with the bounds, then adds it. Atoms whose grade or error is not finite are left out. `number`: its
    /// place in the order of all structures, of this map and of others; it rises.
    pub fn learn(&mut self, number: u64, atoms: &[GradedError<G>]) {
        let finite = |atom: &&GradedError<G>| atom.grade.is_finite() && atom.error.is_finite();
        self.compare(&atoms.iter().filter(finite).collect::<Vec<_>>());
        let mut errors: BTreeMap<_, Vec<f64>> = BTreeMap::new();
        for atom in atoms.iter().filter(finite) {
            let bin = self.bins.index_of(atom.grade);
            for group in [None, Some(atom.group.clone())] {
                errors.entry((group, bin)).or_default().push(atom.error);
            }
        }
        self.structures += u64::from(!errors.is_empty());
        for (key, errors) in errors {
            let window = self.windows.entry(key);
            window.or_insert_with(|| ConformalWindow::new(self.settings)).learn(number, &errors);
        }
    }

    /// Compares the atoms of a structure with their bounds.
    fn compare(&mut self, atoms: &[&GradedError<G>]) {
        let bound = |atom: &GradedError<G>| self.bound(atom.grade, Some(&atom.group));
        let held: Vec<_> = atoms.iter().filter_map(|atom| Some(atom.error <= bound(atom)?)).collect();
        let covered = held.iter().filter(|held| **held).count();
        let outcome = StructureOutcome {
            held: (!held.is_empty()).then(|| covered as f64 / held.len() as f64),
            unbounded: 1.0 - held.len() as f64 / atoms.len() as f64,
        };
        if !atoms.is_empty() && (outcome.held.is_some() || !self.outcomes.is_empty()) {
            self.outcomes.push(outcome);
        }
    }

    /// How often bounds held for the newest structures, each compared with those from before it came. `None` without any.
    pub fn coverage(&self) -> Option<RollingCoverage> {
        let (mut structures, mut covered, mut all, mut unbounded) = (0, 0.0, 0, 0.0);
        for outcome in self.outcomes.iter().rev() {
            all += 1;
            unbounded += outcome.unbounded;
            if let Some(held) = outcome.held {
                structures += 1;
                covered += held;
            }
            if structures == self.settings.counted {
                break;
            }
        }
        (structures > 0).then(|| RollingCoverage {
            share: covered / structures as f64,
            structures,
            unbounded: unbounded / f64::from(all),
        })
    }

    /// The covered share of each structure with a bound, in the order in which they came.
    pub fn outcomes(&self) -> Vec<f64> {
        self.outcomes.iter().filter_map(|outcome| outcome.held).collect()
    }

    /// The windows with data: group (`None`: all atoms), index of the bin.
    pub fn windows(&self) -> impl Iterator<Item = (Option<&G>, usize, &ConformalWindow)> {
        self.windows.iter().map(|((group, bin), window)| (group.as_ref(), *bin, window))
    }

    /// The window that an atom's bound follows from.
    fn sufficient(&self, grade: f64, group: Option<&G>) -> Option<&ConformalWindow> {
        if !grade.is_finite() {
            return None;
        }
        let bin = self.bins.index_of(grade);
        let of = |group| self.windows.get(&(group, bin)).filter(|window| window.is_sufficient());
        group.and_then(|group| of(Some(group.clone()))).or_else(|| of(None))
    }
}
