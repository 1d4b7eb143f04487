//! Why a campaign ended, in words.

use monitor::end_reason::CampaignEnd;

use crate::output::count;

/// The reason in one line.
pub fn describe(end: &CampaignEnd) -> String {
    match end {
        CampaignEnd::AllWalks => "all walks have ended".to_owned(),
        CampaignEnd::Budget { key } => format!("{key} is used up"),
        CampaignEnd::NothingNew { steps } => {
            let steps = steps.map_or(String::new(), |steps| format!(" in {}", count(steps, "step")));
            format!("walks found nothing new{steps} (stop.max_steps_without_structure)")
        }
        CampaignEnd::SmallImprovement { version, improvement } => {
            let percent = 100.0 * improvement;
            let how = match percent < 0.0 {
                true => format!("rises by {:.1} %", -percent),
                false => format!("improves by only {percent:.1} %"),
            };
            format!(
                "the held-out force error of version {version} {how} per 100 labels (stop.min_improvement)"
            )
        }
        CampaignEnd::AllVersions { versions } => {
            format!("{} of the potential trained (refit.max_versions)", count(*versions, "version"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_name_their_limits() {
        for (end, expected) in [
            (CampaignEnd::Budget { key: "budget.labels".into() }, "budget.labels is used up"),
            (
                CampaignEnd::NothingNew { steps: Some(500) },
                "walks found nothing new in 500 steps (stop.max_steps_without_structure)",
            ),
            (
                CampaignEnd::SmallImprovement { version: 2, improvement: 0.0123 },
                "the held-out force error of version 2 improves by only 1.2 % per 100 labels (stop.min_improvement)",
            ),
            (
                CampaignEnd::SmallImprovement { version: 3, improvement: -0.02 },
                "the held-out force error of version 3 rises by 2.0 % per 100 labels (stop.min_improvement)",
            ),
            (
                CampaignEnd::AllVersions { versions: 1 },
                "1 version of the potential trained (refit.max_versions)",
            ),
        ] {
            assert_eq!(describe(&end), expected);
        }
    }
}
