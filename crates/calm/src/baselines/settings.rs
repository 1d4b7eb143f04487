//! The kinds of baselines and their settings.

use std::fmt;
use std::str::FromStr;

use super::error::BaselineError;

/// A kind of baseline.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum BaselineKind {
    /// One uncentred active set for each element.
    DOptimalityElement,
    /// One active set for each component, of features from which its centroid is subtracted.
    DOptimalityCentred,
    /// One uncentred active set for each component.
    DOptimalityComponent,
    /// Last-layer prediction rigidity, from the mean of each structure's features.
    Llpr,
    /// The same from their sum.
    LlprSum,
    /// As [`BaselineKind::Llpr`], with the rows of force components.
    LlprForces,
    /// Distance to the nearest centroid.
    Euclidean,
    /// Distance to the k-th nearest training atom.
    KNearest,
    /// Negative logarithm of the mixture's density.
    Likelihood,
}

impl BaselineKind {
    /// All kinds.
    pub const ALL: [Self; 9] = [
        Self::DOptimalityElement,
        Self::DOptimalityCentred,
        Self::DOptimalityComponent,
        Self::Llpr,
        Self::LlprSum,
        Self::LlprForces,
        Self::Euclidean,
        Self::KNearest,
        Self::Likelihood,
    ];

    /// Its name, in words joined by hyphens.
    pub fn name(self) -> &'static str {
        match self {
            Self::DOptimalityElement => "d-optimality-element",
            Self::DOptimalityCentred => "d-optimality-centred",
            Self::DOptimalityComponent => "d-optimality-component",
            Self::Llpr => "llpr",
            Self::LlprSum => "llpr-sum",
            Self::LlprForces => "llpr-forces",
            Self::Euclidean => "euclidean",
            Self::KNearest => "k-nearest",
            Self::Likelihood => "likelihood",
        }
    }

    pub(super) fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }

    /// All names, for messages.
    pub(super) fn names() -> String {
        format!("one of {}", Self::ALL.map(Self::name).join(", "))
    }

    /// Whether the mixture's components divide the atoms, so that a [`super::Builder`] needs the mixture.
    pub fn needs_mixture(self) -> bool {
        matches!(
            self,
            Self::DOptimalityCentred | Self::DOptimalityComponent | Self::Euclidean | Self::Likelihood
        )
    }

    /// Whether the training data are read; otherwise the mixture has all that is needed.
    pub fn needs_data(self) -> bool {
        !matches!(self, Self::Euclidean | Self::Likelihood)
    }

    /// Whether the builder also takes, and [`super::Baseline::score_forces`] scores, the rows of force components.
    pub fn has_force_form(self) -> bool {
        self == Self::LlprForces
    }
}

impl fmt::Display for BaselineKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for BaselineKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::named(text).ok_or_else(|| format!("expected {}", Self::names()))
    }
}

/// How baselines are built.
#[derive(Debug, Clone, PartialEq)]
pub struct BaselineSettings {
    /// D-optimality: the largest |coefficient| of a training atom may exceed 1 by this.
    pub tolerance: f64,
    /// D-optimality: maximum number of sweeps over the data.
    pub max_sweeps: usize,
    /// D-optimality: a direction counts as present if a training atom reaches further along it than this times the
    /// largest norm of all (centred) features.
    pub rank_tolerance: f64,
    /// LLPR: η in λ = η tr G / D.
    pub regularisation: f64,
    /// LLPR: factor of the rows of force components in G.
    pub force_weight: f64,
    /// k-nearest neighbour distance: k.
    pub neighbours: usize,
    /// The same: most atoms of the sample for each element.
    pub sample: usize,
    /// The same: random seed of the sample.
    pub seed: u64,
}

impl Default for BaselineSettings {
    fn default() -> Self {
        Self {
            tolerance: 0.01,
            max_sweeps: 20,
            rank_tolerance: 1e-8,
            regularisation: 1e-12,
            force_weight: 1.0,
            neighbours: 5,
            sample: 10_000,
            seed: 42,
        }
    }
}

impl BaselineSettings {
    /// Checks the ranges.
    ///
    /// # Errors
    /// The first value that is out of range.
    pub fn check(&self) -> Result<(), BaselineError> {
        let range = |what, found: f64, fits, expected| match fits {
            true => Ok(()),
            false => Err(BaselineError::Setting { what, found, expected }),
        };
        let Self { tolerance, rank_tolerance, regularisation, force_weight, .. } = *self;
        let positive = |value: f64| value.is_finite() && value > 0.0;
        range("tolerance", tolerance, positive(tolerance), "a number above 0")?;
        let fits = rank_tolerance > 1e-14 && rank_tolerance < 1.0;
        range("rank tolerance", rank_tolerance, fits, "a number between 1e-14 and 1")?;
        range("regularisation", regularisation, positive(regularisation), "a number above 0")?;
        range("force weight", force_weight, positive(force_weight), "a number above 0")?;
        for (what, found) in
            [("sweeps", self.max_sweeps), ("neighbours", self.neighbours), ("sample", self.sample)]
        {
            range(what, found as f64, found > 0, "at least 1")?;
        }
        let (k, sample) = (self.neighbours, self.sample);
        range("neighbours", k as f64, k <= sample, "at most the size of the sample")
    }
}
