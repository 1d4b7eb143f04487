//! The state of the mixture in `calmwalk status`: forgetting and staleness.

use std::io::{self, Write};

use calm::forgetting::{ComponentForgetting, ElementForgetting};
use monitor::mixture_values::MixtureValues;

use super::page::StatusLayout;
use crate::output::{TextTable, decimals};

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
    let elements = values.forgetting();
    let is_sampled = number("share_above_one").is_some();
    if let Some(worst) = elements.first().filter(|_| page.is_unlimited() || !is_sampled) {
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
    // Walks that run one after the other have the newest version by construction; one version behind is usual beside others.
    let is_worth_it = |largest: u64| mode == "live" || largest > 0;
    match values.staleness().filter(|staleness| match page.is_unlimited() {
        true => is_worth_it(staleness.largest()),
        false => staleness.quantile(0.9) > 1,
    }) {
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

/// Writes a table of what is forgotten of every element and of its components, the worst element first.
pub fn write_forgetting(out: &mut dyn Write, values: &MixtureValues, page: &StatusLayout) -> io::Result<()> {
    let elements = values.forgetting();
    let mut table =
        TextTable::new(&["training data of", ">component", ">atoms with γ > 1 (%)", ">mean σ² × start"]);
    let mut rows = 0;
    for ElementForgetting { element, mean_square_growth, share_above_one, components } in &elements {
        let share = decimals(share_above_one.map(|share| 100.0 * share), 1);
        table.push(vec![element.clone(), "all".to_owned(), share, format!("{mean_square_growth:.2}")]);
        for ComponentForgetting { component, mean_square_growth } in components {
            let growth = format!("{mean_square_growth:.2}");
            table.push(vec![element.clone(), component.to_string(), "–".to_owned(), growth]);
        }
        rows += 1 + components.len();
    }
    if rows == 0 { Ok(()) } else { page.table(out, &table, rows, rows, "components") }
}

#[cfg(test)]
mod tests {
    use calm::Staleness;
    use serde_json::json;
    use store::records::{STALENESS, TRAINING_FRAMES};

    use super::*;

    fn text(values: &MixtureValues, mode: &str, few: usize) -> String {
        let mut out = Vec::new();
        let page = StatusLayout { walks: 8, others: 8, few, width: 120 };
        write(&mut out, values, &page, mode).unwrap();
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn staleness_is_shown_where_it_matters() {
        let mut staleness = Staleness::default();
        [0, 0, 0].iter().for_each(|age| staleness.add(*age));
        let of =
            |staleness: &Staleness| MixtureValues(vec![(STALENESS.into(), json!(staleness).to_string())]);
        let all = usize::MAX;
        assert_eq!(text(&of(&staleness), "reproducible", all), "");
        assert!(text(&of(&staleness), "live", all).contains("at 100.0 % of decisions"));
        staleness.add(1);
        assert_eq!(text(&of(&staleness), "live", 8), "", "one version behind is usual");
        [1, 2, 7].iter().for_each(|age| staleness.add(*age));
        let shown = text(&of(&staleness), "reproducible", 8);
        assert!(
            shown.contains("42.9 % of decisions; versions behind: median 1, 90 % 7, largest 7"),
            "{shown}"
        );
        let none = MixtureValues(Vec::new());
        assert_eq!(text(&none, "live", all), "");
    }

    #[test]
    fn every_element_and_component_is_listed_on_request() {
        let component =
            |component: u32, growth: f64| json!({ "component": component, "mean_square_growth": growth });
        let training = json!({ "elements": [
            { "element": "O", "mean_square_growth": 1.5, "share_above_one": 0.125,
              "components": [component(0, 1.25), component(3, 2.0)] },
            { "element": "U", "mean_square_growth": 6.5, "share_above_one": null, "components": [component(1, 6.5)] },
        ] });
        let values = MixtureValues(vec![(TRAINING_FRAMES.into(), training.to_string())]);
        let (mut out, page) = (Vec::new(), StatusLayout { width: 120, ..StatusLayout::unlimited() });
        write_forgetting(&mut out, &values, &page).unwrap();
        let text = String::from_utf8(out).unwrap();
        let rows: Vec<Vec<_>> = text.lines().skip(2).map(|line| line.split_whitespace().collect()).collect();
        let expected = [
            ["U", "all", "–", "6.50"],
            ["U", "1", "–", "6.50"],
            ["O", "all", "12.5", "1.50"],
            ["O", "0", "–", "1.25"],
            ["O", "3", "–", "2.00"],
        ];
        assert_eq!(rows, expected, "{text}");
        let mut nothing = Vec::new();
        write_forgetting(&mut nothing, &MixtureValues(Vec::new()), &page).unwrap();
        assert!(nothing.is_empty());
    }
}
