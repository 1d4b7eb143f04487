//! The state of the mixture in `calmwalk status`: forgetting and staleness.

use std::io::{self, Write};

use calm::forgetting::ElementForgetting;
use monitor::mixture_values::MixtureValues;

use super::page::StatusLayout;

/// Writes the lines below the version of the mixture.
pub fn write(out: &mut dyn Write, values: &MixtureValues, page: &StatusLayout, mode: &str) -> io::Result<()> {
    let training = values.training_frames();
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
    let elements: Vec<ElementForgetting> =
        serde_json::from_value(training["elements"].clone()).unwrap_or_default();
    let is_sampled = number("share_above_one").is_some();
    let worst = elements.iter().max_by(|a, b| a.mean_square_growth.total_cmp(&b.mean_square_growth));
    if let Some(worst) = worst.filter(|_| page.is_unlimited() || !is_sampled) {
        page.titled(out, "", &describe_worst(worst, !is_sampled && training["alarm"] == true))?;
    }
    let components = elements.iter().filter_map(|of| Some((of, of.worst_component()?)));
    let worst = components.max_by(|a, b| a.1.mean_square_growth.total_cmp(&b.1.mean_square_growth));
    if let Some((of, worst)) = worst.filter(|_| page.is_unlimited()) {
        let (number, growth) = (worst.component, worst.mean_square_growth);
        page.titled(
            out,
            "",
            &format!("component {number} of {} is forgotten most: σ² × {growth:.2}", of.element),
        )?;
    }
    // Walks that run one after the other have the newest version by construction.
    match values.staleness().filter(|staleness| mode == "live" || staleness.largest() > 0) {
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

/// The element whose training data have moved away most.
fn describe_worst(worst: &ElementForgetting, alarm: bool) -> String {
    let ElementForgetting { element, mean_square_growth, share_above_one, .. } = worst;
    let share = share_above_one.map_or(String::new(), |share| format!(", {:.1} % above 1", 100.0 * share));
    let alarm = if alarm { "; ALARM: the mixture forgets them" } else { "" };
    format!("of its training data, {element} is forgotten most: σ² × {mean_square_growth:.2}{share}{alarm}")
}

#[cfg(test)]
mod tests {
    use calm::Staleness;
    use serde_json::json;
    use store::records::STALENESS;

    use super::*;

    fn text(values: &MixtureValues, mode: &str) -> String {
        let mut out = Vec::new();
        let page = StatusLayout { walks: 8, others: 8, few: 8, width: 120 };
        write(&mut out, values, &page, mode).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn staleness_is_shown_where_it_matters() {
        let mut staleness = Staleness::default();
        [0, 0, 0].iter().for_each(|age| staleness.add(*age));
        let of =
            |staleness: &Staleness| MixtureValues(vec![(STALENESS.into(), json!(staleness).to_string())]);
        assert_eq!(text(&of(&staleness), "reproducible"), "");
        assert!(text(&of(&staleness), "live").contains("at 100.0 % of decisions"));
        [1, 2, 7].iter().for_each(|age| staleness.add(*age));
        let shown = text(&of(&staleness), "reproducible");
        assert!(
            shown.contains("50.0 % of decisions; versions behind: median 0, 90 % 7, largest 7"),
            "{shown}"
        );
        let none = MixtureValues(Vec::new());
        assert_eq!(text(&none, "live"), "");
    }
}
