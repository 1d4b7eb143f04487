//! The state of the mixture in `calmwalk status`: forgetting and staleness.

use std::io::{self, Write};

use orchestrator::selector::{STALENESS, Staleness};
use serde_json::{Value, json};

use super::page::Page;

/// Values that the selector stores with its commits, by name.
#[derive(Debug)]
pub struct MixtureSummary(pub Vec<(String, String)>);

impl MixtureSummary {
    /// The grades of the training frames under the newest mixture; null if they are not monitored.
    pub fn training_frames(&self) -> Value {
        self.read("training_frames").unwrap_or_default()
    }

    /// The fraction of the training atoms with γ > 1, and whether it raises an alarm. `None` before the first update.
    pub fn forgetting(&self) -> Option<(f64, bool)> {
        let training = self.training_frames();
        training["share_above_one"].as_f64().zip(training["alarm"].as_bool())
    }

    /// By how many versions walkers' mixtures were behind the newest at decisions; null before the first decision.
    pub fn staleness(&self) -> Value {
        let Some(staleness) = self.read::<Staleness>(STALENESS) else { return Value::Null };
        let mut json = json!(staleness);
        json["decisions"] = json!(staleness.decisions());
        json["share_of_newest"] = json!(staleness.share_of_newest());
        json["median"] = json!(staleness.quantile(0.5));
        json["quantile_90"] = json!(staleness.quantile(0.9));
        json
    }

    fn read<T: serde::de::DeserializeOwned>(&self, name: &str) -> Option<T> {
        let (_, text) = self.0.iter().find(|(key, _)| key == name)?;
        serde_json::from_str(text).ok()
    }

    /// Writes the lines below the version of the mixture.
    pub fn write(&self, out: &mut dyn Write, page: &Page, mode: &str) -> io::Result<()> {
        let training = self.training_frames();
        let number = |key: &str| training[key].as_f64();
        if let (Some(median), Some(share)) = (number("median"), number("share_above_one")) {
            let alarm = if training["alarm"] == true { "; ALARM: the mixture forgets them" } else { "" };
            let share = 100.0 * share;
            page.titled(
                out,
                "",
                &format!("training atoms under it: median γ {median:.2}, {share:.1} % above 1{alarm}"),
            )?;
        }
        // Walks that run one after the other have the newest version by construction.
        let staleness = self.read::<Staleness>(STALENESS);
        match staleness.filter(|staleness| mode == "live" || staleness.largest() > 0) {
            Some(staleness) => page.titled(
                out,
                "",
                &format!(
                    "walkers had the newest version at {:.1} % of decisions; versions behind: median {}, 90 % {}, \
                     largest {}",
                    100.0 * staleness.share_of_newest(),
                    staleness.quantile(0.5),
                    staleness.quantile(0.9),
                    staleness.largest()
                ),
            ),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(values: &MixtureSummary, mode: &str) -> String {
        let mut out = Vec::new();
        let page = Page { walks: 8, others: 8, few: 8, width: 120 };
        values.write(&mut out, &page, mode).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn staleness_is_shown_where_it_matters() {
        let mut staleness = Staleness::default();
        [0, 0, 0].iter().for_each(|age| staleness.add(*age));
        let of =
            |staleness: &Staleness| MixtureSummary(vec![(STALENESS.into(), json!(staleness).to_string())]);
        assert_eq!(text(&of(&staleness), "reproducible"), "");
        assert!(text(&of(&staleness), "live").contains("at 100.0 % of decisions"));
        [1, 2, 7].iter().for_each(|age| staleness.add(*age));
        let shown = text(&of(&staleness), "reproducible");
        assert!(
            shown.contains("50.0 % of decisions; versions behind: median 0, 90 % 7, largest 7"),
            "{shown}"
        );
        let json = of(&staleness).staleness();
        let expected = json!({
            "counts": { "0": 3, "1": 1, "2": 1, "7": 1 }, "largest": 7, "decisions": 6, "share_of_newest": 0.5,
            "median": 0, "quantile_90": 7,
        });
        assert_eq!(json, expected);
        let none = MixtureSummary(Vec::new());
        assert_eq!((text(&none, "live").as_str(), none.staleness()), ("", Value::Null));
    }
}
