//! The kinds of baselines.

use std::fmt;
use std::str::FromStr;

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
