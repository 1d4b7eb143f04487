//! `[stop]`

use std::num::NonZeroU64;

use calm::rules::Positive;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// When a campaign ends although its walks have steps left and its budget is not used up.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StopSection {
    /// Largest number of steps that the biased walks make together after the last accepted structure. Then all of them end.
    /// Default: no limit.
    pub max_steps_without_structure: Option<NonZeroU64>,
    /// Groups of `[[walks]]` whose steps and structures count for `max_steps_without_structure`, such as those at the conditions that
    /// the potential is for. Default: all.
    pub walks: Option<Vec<String>>,
    /// Smallest relative fall of the force errors on held-out labels, for each 100 labels more than the parent was trained on. A
    /// version with less is the last, and no walk starts with it. Default: none.
    pub min_improvement: Option<Positive>,
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use serde_json::json;

    use crate::config::{Config, compare, demo_without_refit};

    const STEPS: &str = "# max_steps_without_structure = 100000";
    const IMPROVEMENT: &str = "# min_improvement = 0.05";

    /// The demo with the last text behind it, and with `line` in place of another.
    fn with(commented: &str, line: &str, behind: &str) -> String {
        let demo = demo_without_refit();
        assert!(demo.contains(commented), "{commented}");
        format!("{}\n{behind}", demo.replacen(commented, line, 1))
    }

    /// What is wrong with a configuration; empty if nothing is.
    fn errors(text: &str) -> String {
        let loaded = Config::from_draft(Path::new("c.toml"), text.to_owned());
        loaded.err().map(|error| error.to_string()).unwrap_or_default()
    }

    #[test]
    fn each_key_has_its_rule() {
        let refit = |lines: &str| format!("[refit]\nreplay = [\"r.extxyz\"]\n{lines}\n");
        let test_set = "test_sets = [{ name = \"liquid\", file = \"l.extxyz\" }]";
        let (least, steps) = ("min_improvement = 0.02", "max_steps_without_structure");
        let group = "[[walks]]\nname = \"hot\"\n";
        for (commented, line, behind, expected) in [
            (STEPS, format!("{steps} = 5000"), String::new(), ""),
            (STEPS, format!("{steps} = 0"), String::new(), "expected a whole number"),
            (STEPS, format!("{steps} = 2000000000000"), String::new(), "expected at most 1e12"),
            (STEPS, format!("{steps} = 5000\nwalks = [\"hot\"]"), group.into(), ""),
            (
                STEPS,
                format!("{steps} = 5000\nwalks = [\"hto\"]"),
                group.into(),
                "expected a group of [[walks]]: hot",
            ),
            (STEPS, "walks = [\"hot\"]".into(), group.into(), "expected stop.max_steps_without_structure"),
            (IMPROVEMENT, least.into(), refit(""), ""),
            (IMPROVEMENT, least.into(), refit(&format!("held_out = 0\n{test_set}")), ""),
            (IMPROVEMENT, least.into(), String::new(), "stop.min_improvement is 0.02; expected [refit]"),
            (IMPROVEMENT, least.into(), refit("held_out = 0"), "expected refit.held_out above 0, or"),
            (IMPROVEMENT, "min_improvement = -0.1".into(), refit(""), "expected a finite number above 0"),
            (
                IMPROVEMENT,
                "min_improvement = 200".into(),
                refit(""),
                "expected at most 100: it is a fraction",
            ),
        ] {
            let text = with(commented, &line, &behind);
            let found = errors(&text);
            assert_eq!(found.is_empty(), expected.is_empty(), "{line}: {found}");
            // The last line of several is the one that is wrong.
            let wrong = line.lines().last().unwrap();
            let number = 1 + text.lines().position(|one| one.starts_with(wrong)).unwrap();
            let at = if expected.is_empty() { String::new() } else { format!("c.toml:{number}:") };
            assert!(found.starts_with(&at) && found.contains(expected), "{found}\nexpected {at} {expected}");
        }
    }

    #[test]
    fn a_started_campaign_may_change_it() {
        let value = |text: &str| {
            let config = Config::from_draft(Path::new("c.toml"), text.to_owned()).unwrap().config;
            json!({ "stop": config.stop })
        };
        let (before, after) =
            (value(&demo_without_refit()), value(&with(STEPS, "max_steps_without_structure = 5000", "")));
        let changes = compare(&before, &after).unwrap();
        let shown: Vec<_> = changes.iter().map(ToString::to_string).collect();
        assert_eq!(shown, ["stop.max_steps_without_structure is now 5000 (was left out)"]);
        // Campaigns that began before the section existed have none.
        assert_eq!(compare(&json!({}), &before), Ok(Vec::new()));
    }
}
