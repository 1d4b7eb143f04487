//! Builds a baseline from training data.

use super::Baseline;
use super::d_optimality::DOptimalityBuilder;
use super::distances::{Euclidean, KNearestBuilder};
use super::error::{BaselineError, check};
use super::kind::BaselineKind;
use super::likelihood::Likelihood;
use super::llpr::LlprBuilder;
use super::settings::BaselineSettings;
use crate::mixture::Mixture;

/// A baseline under construction.
///
/// Call [`Builder::add`] for all structures, then [`Builder::end_sweep`], and repeat both while that returns true; then
/// [`Builder::finish`]. Structures must come in the same order each time.
#[derive(Debug, Clone)]
pub struct Builder {
    kind: BaselineKind,
    dimension: usize,
    state: BuilderState,
    is_done: bool,
}

#[derive(Debug, Clone)]
enum BuilderState {
    DOptimality(Box<DOptimalityBuilder>),
    Llpr(LlprBuilder),
    KNearest(KNearestBuilder),
    /// Of a mixture alone.
    Ready(Baseline),
}

impl Builder {
    /// A baseline of `elements` elements and features of dimension D. Kinds that divide atoms by component need the
    /// mixture ([`BaselineKind::needs_mixture`]).
    ///
    /// # Errors
    /// Settings out of range; no mixture, or one of other elements or features; one without statistics
    /// ([`BaselineKind::Likelihood`]).
    pub fn new(
        kind: BaselineKind,
        settings: &BaselineSettings,
        dimension: usize,
        elements: usize,
        mixture: Option<&Mixture>,
    ) -> Result<Self, BaselineError> {
        settings.check()?;
        if dimension == 0 {
            let expected = "at least 1";
            return Err(BaselineError::Setting { what: "feature dimension", found: 0.0, expected });
        }
        let needed = || mixture.ok_or(BaselineError::NoMixture { kind });
        if kind.needs_mixture() {
            let mixture = needed()?;
            expect("features", mixture.dimension(), dimension)?;
            expect("elements", mixture.element_count(), elements)?;
        }
        let state = match kind {
            BaselineKind::DOptimalityElement
            | BaselineKind::DOptimalityCentred
            | BaselineKind::DOptimalityComponent => {
                let builder = DOptimalityBuilder::new(kind, settings, dimension, elements, mixture);
                BuilderState::DOptimality(Box::new(builder))
            }
            BaselineKind::Llpr | BaselineKind::LlprSum | BaselineKind::LlprForces => {
                BuilderState::Llpr(LlprBuilder::new(kind, settings, dimension))
            }
            BaselineKind::KNearest => {
                BuilderState::KNearest(KNearestBuilder::new(settings, dimension, elements))
            }
            BaselineKind::Euclidean => BuilderState::Ready(Baseline::Euclidean(Euclidean::new(needed()?))),
            BaselineKind::Likelihood => {
                BuilderState::Ready(Baseline::Likelihood(Likelihood::new(needed()?)?))
            }
        };
        Ok(Self { kind, dimension, is_done: !kind.needs_data(), state })
    }

    /// What is built.
    pub fn kind(&self) -> BaselineKind {
        self.kind
    }

    /// Whether a sweep over the data is needed.
    pub fn needs_sweep(&self) -> bool {
        !self.is_done
    }

    /// Adds a structure: the element index of each atom and the features, `[atoms × D]`.
    ///
    /// # Errors
    /// Wrong lengths, unknown elements, features that are not finite.
    pub fn add(&mut self, elements: &[usize], features: &[f64]) -> Result<(), BaselineError> {
        if self.is_done {
            return Ok(());
        }
        check(self.dimension, elements, features)?;
        match &mut self.state {
            BuilderState::DOptimality(builder) => builder.add(elements, features),
            BuilderState::Llpr(builder) => {
                builder.add(features);
                Ok(())
            }
            BuilderState::KNearest(builder) => builder.add(elements, features),
            BuilderState::Ready(_) => Ok(()),
        }
    }

    /// Adds the rows of the same structure's force components, `[3 atoms × D]` as for
    /// [`Baseline::score_forces`], where the kind has them ([`BaselineKind::has_force_form`]).
    ///
    /// # Errors
    /// A wrong length, rows that are not finite.
    pub fn add_forces(&mut self, rows: &[f64]) -> Result<(), BaselineError> {
        match &mut self.state {
            BuilderState::Llpr(builder) => builder.add_forces(rows),
            _ => Ok(()),
        }
    }

    /// Ends a sweep over the data. Returns whether another one is needed.
    pub fn end_sweep(&mut self) -> bool {
        self.is_done = match &mut self.state {
            BuilderState::DOptimality(builder) => self.is_done || !builder.end_sweep(),
            _ => true,
        };
        !self.is_done
    }

    /// The baseline.
    ///
    /// # Errors
    /// No data; linear algebra that failed.
    pub fn finish(self) -> Result<Baseline, BaselineError> {
        match self.state {
            BuilderState::DOptimality(builder) => builder.finish().map(Baseline::DOptimality),
            BuilderState::Llpr(builder) => builder.finish().map(Baseline::Llpr),
            BuilderState::KNearest(builder) => builder.finish().map(Baseline::KNearest),
            BuilderState::Ready(baseline) => Ok(baseline),
        }
    }
}

fn expect(what: &'static str, found: usize, expected: usize) -> Result<(), BaselineError> {
    if found == expected { Ok(()) } else { Err(BaselineError::Mixture { what, found, expected }) }
}
