//! Builds a baseline from training data.

use super::Baseline;
use super::d_optimality::DOptimalityBuilder;
use super::distances::{Euclidean, KNearestBuilder};
use super::error::{BaselineError, check};
use super::likelihood::Likelihood;
use super::llpr::LlprBuilder;
use super::settings::{BaselineSettings, Kind};
use crate::mixture::Mixture;

/// A baseline under construction.
///
/// Call [`Builder::add`] for all structures, then [`Builder::end_sweep`], and repeat both while that returns true; then
/// [`Builder::finish`]. Structures must come in the same order each time.
#[derive(Debug, Clone)]
pub struct Builder {
    kind: Kind,
    dimension: usize,
    state: State,
    is_done: bool,
}

#[derive(Debug, Clone)]
enum State {
    DOptimality(Box<DOptimalityBuilder>),
    Llpr(LlprBuilder),
    KNearest(KNearestBuilder),
    /// Of a mixture alone.
    Ready(Baseline),
}

impl Builder {
    /// A baseline of `elements` elements and features of dimension D. Kinds that divide atoms by component need the
    /// mixture ([`Kind::needs_mixture`]).
    ///
    /// # Errors
    /// Settings out of range; no mixture, or one of other elements or features; one without statistics
    /// ([`Kind::Likelihood`]).
    pub fn new(
        kind: Kind,
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
            Kind::DOptimalityElement | Kind::DOptimalityCentred | Kind::DOptimalityComponent => {
                let builder = DOptimalityBuilder::new(kind, settings, dimension, elements, mixture);
                State::DOptimality(Box::new(builder))
            }
            Kind::Llpr | Kind::LlprSum | Kind::LlprForces => {
                State::Llpr(LlprBuilder::new(kind, settings, dimension))
            }
            Kind::KNearest => State::KNearest(KNearestBuilder::new(settings, dimension, elements)),
            Kind::Euclidean => State::Ready(Baseline::Euclidean(Euclidean::new(needed()?))),
            Kind::Likelihood => State::Ready(Baseline::Likelihood(Likelihood::new(needed()?)?)),
        };
        Ok(Self { kind, dimension, is_done: !kind.needs_data(), state })
    }

    /// What is built.
    pub fn kind(&self) -> Kind {
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
            State::DOptimality(builder) => builder.add(elements, features),
            State::Llpr(builder) => {
                builder.add(features);
                Ok(())
            }
            State::KNearest(builder) => builder.add(elements, features),
            State::Ready(_) => Ok(()),
        }
    }

    /// Adds the rows of the same structure's force components, `[3 atoms × D]` as for
    /// [`Baseline::score_forces`], where the kind has them ([`Kind::has_force_form`]).
    ///
    /// # Errors
    /// A wrong length, rows that are not finite.
    pub fn add_forces(&mut self, rows: &[f64]) -> Result<(), BaselineError> {
        match &mut self.state {
            State::Llpr(builder) => builder.add_forces(rows),
            _ => Ok(()),
        }
    }

    /// Ends a sweep over the data. Returns whether another one is needed.
    pub fn end_sweep(&mut self) -> bool {
        self.is_done = match &mut self.state {
            State::DOptimality(builder) => self.is_done || !builder.end_sweep(),
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
            State::DOptimality(builder) => builder.finish().map(Baseline::DOptimality),
            State::Llpr(builder) => builder.finish().map(Baseline::Llpr),
            State::KNearest(builder) => builder.finish().map(Baseline::KNearest),
            State::Ready(baseline) => Ok(baseline),
        }
    }
}

fn expect(what: &'static str, found: usize, expected: usize) -> Result<(), BaselineError> {
    if found == expected { Ok(()) } else { Err(BaselineError::Mixture { what, found, expected }) }
}
