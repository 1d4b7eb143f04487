//! Why a campaign ended.

use serde::Serialize;
use serde_json::Value;
use store::{CampaignStatus, Store, StoreError, VersionRecord};

use crate::improvement::{Improvement, trained_versions};

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
        let configuration = store.campaign().await?.configuration_in_force;
        let configuration = serde_json::from_str(&configuration).unwrap_or_default();
        Ok(Self::find(status, &configuration, &store.versions().await?))
    }

    /// Why a campaign with this configuration ended. `None` if it is not finished, or a version of the potential is left to train.
    pub fn find(status: &CampaignStatus, configuration: &Value, versions: &[VersionRecord]) -> Option<Self> {
        if !status.finished {
            return None;
        }
        // A budget of time allows no refit either; one of structures does.
        let may_refit = status.budget.limits.time_used_up(&status.budget.used).is_none();
        if may_refit && is_refit_left(configuration, versions, status.candidates.accepted) {
            return None;
        }
        if let Some(key) = &status.budget.used_up {
            return Some(Self::Budget { key: key.clone() });
        }
        if let Some(found) = small_improvement(configuration, versions) {
            let improvement = found.per_100_labels();
            return Some(Self::SmallImprovement { version: found.version, improvement });
        }
        if found_nothing_new(status) {
            let steps = configuration["stop"]["max_steps_without_structure"].as_u64();
            return Some(Self::NothingNew { steps });
        }
        let trained = trained_versions(versions).count() as u64;
        let all = max_versions(configuration).filter(|most| trained >= *most);
        Some(all.map_or(Self::AllWalks, |_| Self::AllVersions { versions: trained }))
    }
}

/// Whether a version of the potential is left to train when all walks have ended, after which walks go on.
pub async fn is_refit_due(store: &Store) -> Result<bool, StoreError> {
    let configuration = store.campaign().await?.configuration_in_force;
    let configuration = serde_json::from_str(&configuration).unwrap_or_default();
    if max_versions(&configuration).is_none() {
        return Ok(false);
    }
    let accepted = store.accepted_structures().await?;
    Ok(is_refit_left(&configuration, &store.versions().await?, accepted))
}

fn is_refit_left(configuration: &Value, versions: &[VersionRecord], accepted: u64) -> bool {
    let trained = trained_versions(versions).count() as u64;
    let before = versions.iter().map(|version| version.structures).max().unwrap_or(0);
    max_versions(configuration).is_some_and(|most| trained < most)
        && accepted > before
        && small_improvement(configuration, versions).is_none()
}

/// `refit.max_versions`; `None` without a refit.
fn max_versions(configuration: &Value) -> Option<u64> {
    configuration["refit"]["max_versions"].as_u64()
}

/// The improvement of the newest version if it is below `stop.min_improvement`.
fn small_improvement(configuration: &Value, versions: &[VersionRecord]) -> Option<Improvement> {
    let least = configuration["stop"]["min_improvement"].as_f64()?;
    Improvement::of_newest(versions).filter(|found| found.per_100_labels() < least)
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
    use store::{Budget, BudgetStatus, Candidates, WalkStatus};
    use wire::WalkConditions;

    use super::*;
    use crate::improvement::tests::version;

    /// A finished campaign with these ends of biased walks, each with the version of the potential, and 200 accepted structures.
    fn finished(ends: &[(&str, u32)]) -> CampaignStatus {
        let walk = |(state, version): &(&str, u32)| WalkStatus {
            origin: "biased".into(),
            state: (*state).into(),
            conditions: Some(WalkConditions { version: *version, ..WalkConditions::default() }),
            ..WalkStatus::default()
        };
        CampaignStatus {
            finished: true,
            walks: ends.iter().map(walk).collect(),
            candidates: Candidates { accepted: 200, ..Candidates::default() },
            ..CampaignStatus::default()
        }
    }

    #[test]
    fn a_campaign_without_versions_ends_by_its_walks() {
        let status = finished(&[("completed", 0), ("diverged", 0)]);
        assert_eq!(CampaignEnd::find(&status, &json!({}), &[]), Some(CampaignEnd::AllWalks));
        let status = finished(&[("completed", 0), ("nothing_new", 0)]);
        let configuration =
            json!({ "stop": { "max_steps_without_structure": 500, "min_improvement": null } });
        let nothing_new = CampaignEnd::NothingNew { steps: Some(500) };
        assert_eq!(CampaignEnd::find(&status, &configuration, &[]), Some(nothing_new));
        let budget = BudgetStatus { used_up: Some("budget.labels".into()), ..BudgetStatus::default() };
        let used_up = CampaignStatus { budget, ..status.clone() };
        let end = CampaignEnd::find(&used_up, &configuration, &[]).unwrap();
        assert_eq!(json!(end), json!({ "kind": "budget", "key": "budget.labels" }));
        let unfinished = CampaignStatus { finished: false, ..used_up };
        assert_eq!(CampaignEnd::find(&unfinished, &configuration, &[]), None);
    }

    #[test]
    fn a_campaign_with_versions_ends_with_the_last() {
        let configuration = |least: Option<f64>, most: u32| json!({ "stop": { "min_improvement": least }, "refit": { "max_versions": most } });
        let first = version(1, 100, "held_out", [1.0, 0.5]);
        let versions = [first, version(2, 200, "held_out", [0.5, 0.48])];
        let status = finished(&[("nothing_new", 0), ("superseded", 1), ("completed", 2)]);
        let found = |least, most, versions: &[VersionRecord]| {
            CampaignEnd::find(&status, &configuration(least, most), versions)
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
            CampaignEnd::find(&status, &configuration(None, 3), &versions[..1])
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
