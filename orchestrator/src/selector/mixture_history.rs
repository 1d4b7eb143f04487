//! Follows the mixture through the decision log of a campaign.
//!
//! Only three kinds of decisions matter: an accepted candidate updates the mixture, a decision on forgetting makes later
//! updates additive, and the end of a walk may restart the original mixture. A new version of the potential has a mixture, and
//! so a history, of its own. Declined candidates do not matter, so their
//! features are not needed.

use std::sync::Arc;

use calm::Mixture;
use serde_json::Value;
use store::records::LoggedDecision;

use super::decide::{FORGETTING, update_settings, update_summary};
use super::replay::{ReplayError, damaged};

/// The mixture after each decision, from the first on.
pub struct MixtureHistory {
    settings: calm::UpdateSettings,
    original: Arc<Mixture>,
    mixture: Arc<Mixture>,
    switched_to_additive: bool,
}

/// An accepted candidate.
#[derive(Clone, Copy, Debug)]
pub struct AcceptedAtoms<'a> {
    /// Element index of each atom.
    pub elements: &'a [usize],
    /// Features z, [n × D].
    pub features: &'a [f64],
}

impl MixtureHistory {
    /// The mixture before the first decision, or after the one that switched to a version of the potential: `original` at the version
    /// of the mixture that the log has there. `settings` are those of [`super::SelectorSettings::search`], which never
    /// change during a campaign.
    pub fn new(settings: calm::UpdateSettings, original: Arc<Mixture>) -> Self {
        Self { settings, mixture: Arc::clone(&original), original, switched_to_additive: false }
    }

    /// The mixture after the last decision.
    pub fn mixture(&self) -> &Arc<Mixture> {
        &self.mixture
    }

    /// Whether the next decision of the log updated the mixture with its candidate.
    pub fn is_update(&self, next: &LoggedDecision) -> bool {
        next.kind == "accepted" && next.mixture_version > self.mixture.version()
    }

    /// Takes the next decision of the log, with its candidate if [`Self::is_update`]. Returns what the decision log
    /// should have of the update, as `update` in the detail.
    ///
    /// # Errors
    /// A damaged log: an update without a candidate or with an unusable one, or another version of the mixture after the
    /// decision than recorded.
    pub fn apply(
        &mut self,
        next: &LoggedDecision,
        candidate: Option<AcceptedAtoms<'_>>,
    ) -> Result<Option<Value>, ReplayError> {
        let mut update = None;
        if self.is_update(next) {
            let candidate = candidate.ok_or_else(|| damaged(next, "its candidate is missing"))?;
            update = Some(self.update(candidate).map_err(|error| damaged(next, &error))?);
        } else if next.kind == "ended" && next.mixture_version > self.mixture.version() {
            self.mixture = Arc::new(self.original.at_version(self.mixture.version() + 1));
        } else if next.kind == FORGETTING {
            self.switched_to_additive = true;
        }
        let version = self.mixture.version();
        if version == next.mixture_version {
            return Ok(update);
        }
        let recorded = next.mixture_version;
        Err(damaged(next, &format!("mixture version {recorded} after it, expected version {version}")))
    }

    fn update(&mut self, AcceptedAtoms { elements, features }: AcceptedAtoms<'_>) -> Result<Value, String> {
        let settings = update_settings(&self.settings, self.switched_to_additive);
        let outcome = calm::update(&self.mixture, elements, features, &settings)
            .map_err(|error| format!("its candidate cannot update the mixture: {error}"))?;
        let next = self.mixture.with_changes(&outcome.changed).map_err(|error| error.to_string())?;
        self.mixture = Arc::new(next);
        Ok(update_summary(&outcome))
    }
}
