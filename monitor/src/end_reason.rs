//! Why a campaign ended.

use serde::Serialize;
use serde_json::Value;
use store::{CampaignStatus, Store, StoreError};

use crate::improvement::trained_versions;
use crate::refit_progress::{RefitProgress, RefitRules};

/// Why a campaign ended.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum CampaignEnd {
    /// Every walk has ended for itself: it made its steps, collected its quota, or ended early.
    AllWalks,
    /// A budget is used up.
    Budget {
        /// Its key of the configuration.
        key: String,
    },
    /// The biased walks found nothing new for as many steps as they may.
    NothingNew {
        /// `stop.max_steps_without_structure`.
        steps: Option<u64>,
    },
    /// The newest version of the potential improved by less than `stop.min_improvement`.
    SmallImprovement {
        /// Its number.
        version: u32,
        /// Relative fall of the force errors on labels held out for each 100 labels.
        improvement: f64,
    },
    /// As many versions of the potential are trained as there may be.
    AllVersions {
        /// Their number.
        versions: u64,
    },
}

impl CampaignEnd {
    /// Reads why the campaign with this status ended; `None` if it is not finished.
    pub async fn read(store: &Store, status: &CampaignStatus) -> Result<Option<Self>, StoreError> {
        if !status.finished {
            return Ok(None);
        }
        let configuration = configuration_in_force(store).await?;
        let progress = RefitProgress::read(store, RefitRules::from_json(&configuration)).await?;
        Ok(Self::find(status, &configuration, &progress))
    }

    /// Why a campaign with this configuration ended. `None` if it is not finished, or a version of the potential is left to train.
    pub fn find(status: &CampaignStatus, configuration: &Value, progress: &RefitProgress) -> Option<Self> {
        if !status.finished {
            return None;
        }
        // A budget of time allows no refit either; one of structures does.
        let may_refit = status.budget.limits.time_used_up(&status.budget.used).is_none();
        if may_refit && progress.is_refit_left() {
            return None;
        }
        if let Some(key) = &status.budget.used_up {
            return Some(Self::Budget { key: key.clone() });
        }
        if let Some(found) = progress.small_improvement() {
            let improvement = found.per_100_labels();
            return Some(Self::SmallImprovement { version: found.version, improvement });
        }
        if found_nothing_new(status) {
            let steps = configuration["stop"]["max_steps_without_structure"].as_u64();
            return Some(Self::NothingNew { steps });
        }
        let is_last = progress.rules.max_versions > 0 && progress.are_all_trained();
        let versions = trained_versions(&progress.versions).count() as u64;
        Some(if is_last { Self::AllVersions { versions } } else { Self::AllWalks })
    }
}

/// Whether a version of the potential is left to train when all walks have ended, after which walks continue.
pub async fn is_refit_due(store: &Store) -> Result<bool, StoreError> {
    let rules = RefitRules::from_json(&configuration_in_force(store).await?);
    Ok(rules.max_versions > 0 && RefitProgress::read(store, rules).await?.is_refit_left())
}

async fn configuration_in_force(store: &Store) -> Result<Value, StoreError> {
    let configuration = store.campaign().await?.configuration_in_force;
    Ok(serde_json::from_str(&configuration).unwrap_or_default())
}

/// Whether biased walks of the newest version of the potential ended because they found nothing new.
fn found_nothing_new(status: &CampaignStatus) -> bool {
    let biased = || status.walks.iter().filter(|walk| walk.origin == "biased");
    let version = |walk: &store::WalkStatus| walk.conditions.as_ref().map_or(0, |of| of.version);
    let newest = biased().map(version).max();
    biased().any(|walk| walk.state == "nothing_new" && Some(version(walk)) == newest)
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use store::{Budget, BudgetStatus, VersionRecord, WalkStatus};
    use wire::WalkConditions;

    use super::*;
    use crate::improvement::tests::version;

    /// A finished campaign with these ends of biased walks, each with the version of the potential.
    fn finished(ends: &[(&str, u32)]) -> CampaignStatus {
        let walk = |(state, version): &(&str, u32)| WalkStatus {
            origin: "biased".into(),
            state: (*state).into(),
            conditions: Some(WalkConditions { version: *version, ..WalkConditions::default() }),
            ..WalkStatus::default()
        };
        CampaignStatus { finished: true, walks: ends.iter().map(walk).collect(), ..CampaignStatus::default() }
    }

    #[test]
    fn a_campaign_without_versions_ends_by_its_walks() {
        let status = finished(&[("completed", 0), ("diverged", 0)]);
        assert_eq!(
            CampaignEnd::find(&status, &json!({}), &RefitProgress::default()),
            Some(CampaignEnd::AllWalks)
        );
        let status = finished(&[("completed", 0), ("nothing_new", 0)]);
        let configuration =
            json!({ "stop": { "max_steps_without_structure": 500, "min_improvement": null } });
        let nothing_new = CampaignEnd::NothingNew { steps: Some(500) };
        assert_eq!(CampaignEnd::find(&status, &configuration, &RefitProgress::default()), Some(nothing_new));
        let budget = BudgetStatus { used_up: Some("budget.labels".into()), ..BudgetStatus::default() };
        let used_up = CampaignStatus { budget, ..status.clone() };
        let end = CampaignEnd::find(&used_up, &configuration, &RefitProgress::default()).unwrap();
        assert_eq!(json!(end), json!({ "kind": "budget", "key": "budget.labels" }));
        let unfinished = CampaignStatus { finished: false, ..used_up };
        assert_eq!(CampaignEnd::find(&unfinished, &configuration, &RefitProgress::default()), None);
    }

    #[test]
    fn a_campaign_with_versions_ends_with_the_last() {
        let first = version(1, 100, "held_out", [1.0, 0.5]);
        let versions = [first, version(2, 200, "held_out", [0.5, 0.48])];
        let status = finished(&[("nothing_new", 0), ("superseded", 1), ("completed", 2)]);
        let progress = |least, most, versions: &[VersionRecord]| RefitProgress {
            rules: RefitRules { min_improvement: least, max_versions: most, ..RefitRules::default() },
            versions: versions.to_vec(),
            accepted: 200,
            ..RefitProgress::default()
        };
        let found = |least, most, versions: &[VersionRecord]| {
            CampaignEnd::find(&status, &json!({}), &progress(least, most, versions))
        };
        assert_eq!(found(None, 2, &versions), Some(CampaignEnd::AllVersions { versions: 2 }));
        assert_eq!(
            found(None, 3, &versions),
            Some(CampaignEnd::AllWalks),
            "nothing new since the last version"
        );
        assert_eq!(found(None, 3, &versions[..1]), None, "another version will be trained");
        let used_up = |limits| {
            let budget = BudgetStatus { used_up: Some("budget.x".into()), limits, ..BudgetStatus::default() };
            let status = CampaignStatus { budget, ..status.clone() };
            CampaignEnd::find(&status, &json!({}), &progress(None, 3, &versions[..1]))
        };
        assert_eq!(used_up(Budget::default()), None, "another version follows a budget of structures");
        let no_time = Budget { wall_hours: Some(0.0), ..Budget::default() };
        assert_eq!(used_up(no_time), Some(CampaignEnd::Budget { key: "budget.x".into() }));
        let Some(CampaignEnd::SmallImprovement { version, improvement }) = found(Some(0.05), 3, &versions)
        else {
            panic!("it improved by 4 %");
        };
        assert!(version == 2 && (improvement - 0.04).abs() < 1e-12, "{version} {improvement}");
        assert_eq!(found(Some(0.03), 2, &versions), Some(CampaignEnd::AllVersions { versions: 2 }));
    }
}
