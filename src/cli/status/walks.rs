//! The walks of a campaign in `calmwalk status`.

use std::cmp::Reverse;
use std::io::{self, Write};

use store::WalkStatus;
use wire::conditions::VariedConditions;

use super::page::{StatusLayout, cut_middle, name_width};
use crate::output::{TextTable, decimals};

/// Least width of the name of a seed structure.
pub const NAME: usize = 9;

/// Titles of the columns in the format of [`TextTable::new`].
pub const TITLES: [&str; 10] =
    [">walk", "structure", "state", ">step", ">steps/s", ">T (K)", ">V/V₀", ">γ_max", ">γ₀_max", ">taken"];

/// Selects at most `most` walks, in order of their numbers: running walks with the largest γ first, then those that started
/// last.
fn select(walks: &[WalkStatus], most: usize) -> Vec<&WalkStatus> {
    let mut shown: Vec<_> = walks.iter().collect();
    if shown.len() > most {
        let gamma = |walk: &WalkStatus| (1e6 * walk.gamma_max.unwrap_or_default().clamp(0.0, 1e9)) as u64;
        shown.sort_by_cached_key(|walk| match walk.is_active() {
            true => (0, walk.steps_per_second.is_none(), Reverse(gamma(walk)), Reverse(walk.walk)),
            false => (1, true, Reverse(0), Reverse(walk.walk)),
        });
        shown.truncate(most);
        shown.sort_by_key(|walk| walk.walk);
    }
    shown
}

/// Writes a table of the walks.
pub fn write(
    out: &mut dyn Write,
    walks: &[WalkStatus],
    run_active: bool,
    page: &StatusLayout,
) -> io::Result<()> {
    let shown = select(walks, page.walks);
    if shown.is_empty() {
        return Ok(());
    }
    let mut table = TextTable::new(&TITLES);
    let varied = VariedConditions::among(walks.iter().filter_map(|walk| walk.conditions.as_ref()));
    let name = if page.walks == usize::MAX { usize::MAX } else { width_of_names(walks) };
    for walk in &shown {
        table.push(line(walk, &varied, run_active, name));
    }
    table.drop_unknown();
    page.table(out, &table, shown.len(), walks.len(), "walks")
}

/// The width at which names of seed structures are cut, so that they still differ.
pub fn width_of_names(walks: &[WalkStatus]) -> usize {
    name_width(walks.iter().map(|walk| walk.seed_structure.as_str()), NAME)
}

/// The row of a walk below [`TITLES`], with at most `name` characters of its name. `varied`: the conditions that
/// distinguish walks. `run_active`: whether an orchestrator runs.
pub fn line(walk: &WalkStatus, varied: &VariedConditions, run_active: bool, name: usize) -> Vec<String> {
    let control = if walk.origin == "control" { "c: " } else { "" };
    let conditions = walk.conditions.as_ref().map_or(String::new(), |conditions| varied.describe(conditions));
    let of_seed = format!("{control}{}", cut_middle(&walk.seed_structure, name));
    let name = if conditions.is_empty() { of_seed } else { format!("{of_seed} ({conditions})") };
    let state = match walk.state.as_str() {
        _ if walk.paused => "paused".to_owned(),
        "running" if !run_active => "stopped".to_owned(),
        _ if walk.reference_step.is_some() => "reference run".to_owned(),
        state => state.replace('_', " "),
    };
    vec![
        walk.walk.to_string(),
        name,
        state,
        walk.reference_step.unwrap_or(walk.step).to_string(),
        decimals(walk.steps_per_second, 1),
        decimals(walk.temperature, 0),
        decimals(walk.relative_volume, 3),
        decimals(walk.gamma_max, 2),
        decimals(walk.gamma_max_original, 2),
        walk.accepted.to_string(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn walk(number: u32, state: &str, gamma: f64, speed: Option<f64>) -> WalkStatus {
        WalkStatus {
            walk: number,
            state: state.into(),
            gamma_max: Some(gamma),
            steps_per_second: speed,
            ..WalkStatus::default()
        }
    }

    #[test]
    fn a_walk_in_its_reference_run_shows_its_steps_there() {
        let walk = WalkStatus { reference_step: Some(3200), ..walk(1, "running", 0.0, Some(10.0)) };
        let row = line(&walk, &VariedConditions::default(), true, NAME);
        assert_eq!((row[2].as_str(), row[3].as_str(), row[4].as_str()), ("reference run", "3200", "10.0"));
    }

    #[test]
    fn running_walks_with_large_grades_have_priority() {
        let mut walks: Vec<_> = (0..50).map(|number| walk(number, "quota_reached", 9.0, None)).collect();
        walks[3] = walk(3, "running", 1.2, Some(10.0));
        walks[4] = walk(4, "running", 2.5, Some(10.0));
        walks[5] = walk(5, "waiting", 3.5, None);
        let numbers = |most| select(&walks, most).iter().map(|walk| walk.walk).collect::<Vec<_>>();
        assert_eq!((numbers(1), numbers(2), numbers(3)), (vec![4], vec![3, 4], vec![3, 4, 5]));
        assert_eq!((numbers(5), numbers(usize::MAX).len()), (vec![3, 4, 5, 48, 49], 50));
    }
}
