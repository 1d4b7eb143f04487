//! The rules of a configuration that no single value can check.

use std::collections::HashSet;

use atoms::MinDistanceRule;
use md::{ThermostatSettings, WrongSetting};
use orchestrator::selector::{Mode, UpdateProtocol};
use potentials::{RadiiWindows, ZblWindow, ZblWindows};
use store::ServerUrl;

use super::error::Wrong;
use super::ranges;
use super::{Config, LabelSection, NotifySection, QueueFull};

/// Largest shortest distance of a pair of elements, Å.
const MAX_MIN_DISTANCE: f64 = 10.0;

/// Largest number of walks under the same conditions.
const MAX_REPEATS: u32 = 1000;

/// Checks a configuration as a whole; everything that is wrong.
pub fn check(config: &Config) -> Vec<Wrong> {
    let checks = [
        check_mixture(config),
        check_thermostat(config),
        check_min_distances(config),
        check_zbl(config),
        check_groups(config),
        check_temperature(config),
        check_store(config),
        check_queue(config),
        check_budget(config),
        check_notify(&config.notify),
        check_seeds(config),
    ];
    checks.into_iter().filter_map(Result::err).chain(check_label(&config.label)).collect()
}

fn check_seeds(config: &Config) -> Result<(), Wrong> {
    if config.seed_structures.files.is_empty() {
        return wrong("seed_structures.files", "an empty list", "at least one file with seed structures");
    }
    Ok(())
}

fn check_notify(notify: &NotifySection) -> Result<(), Wrong> {
    if notify.command.as_ref().is_some_and(|command| command.first().is_none_or(String::is_empty)) {
        return wrong("notify.command", "an empty command", "a program, and its arguments");
    }
    Ok(())
}

fn wrong(key: &str, found: impl ToString, expected: impl ToString) -> Result<(), Wrong> {
    Err((key.to_owned(), found.to_string(), expected.to_string()))
}

/// The text of a configuration is kept in the database, where no password belongs.
fn check_store(config: &Config) -> Result<(), Wrong> {
    let Some(store) = &config.run.store else { return Ok(()) };
    match store.parse::<ServerUrl>() {
        Ok(url) if url.has_password() => {
            let expected = "a URL without its password: that is taken from PGPASSWORD or ~/.pgpass";
            wrong("run.store", format!("{url} with a password"), expected)
        }
        Ok(_) => Ok(()),
        Err(error) => wrong("run.store", error, "the URL of a PostgreSQL database"),
    }
}

/// Fewer labels than one structure takes are no campaign.
fn check_budget(config: &Config) -> Result<(), Wrong> {
    let least = config.labels_of_each();
    match config.budget.labels {
        Some(labels) if labels.get() < least => {
            let expected = format!("at least {least}: a structure and its control frame");
            wrong("budget.labels", labels, expected)
        }
        _ => Ok(()),
    }
}

/// How long the queue is depends on how fast labels are made, which is not the same twice.
fn check_queue(config: &Config) -> Result<(), Wrong> {
    if config.label.on_queue_full == QueueFull::Raise && config.campaign.mode == Mode::Reproducible {
        let expected = "\"wait\", or mode = \"live\": what is collected would depend on how fast labels are made, and a \
                        reproducible campaign must not";
        return wrong("label.on_queue_full", "\"raise\"", expected);
    }
    Ok(())
}

/// What can be said of labels without the rest; everything that is wrong.
pub fn check_label(label: &LabelSection) -> Vec<Wrong> {
    let guard =
        label.guard.fault().map(|(key, found, expected)| (key.to_owned(), found, expected.to_owned()));
    let checks = [check_pass_environment(label), check_batch_options(label), check_scratch(label)];
    guard.into_iter().chain(checks.into_iter().filter_map(Result::err)).collect()
}

fn check_pass_environment(label: &LabelSection) -> Result<(), Wrong> {
    let Some(pattern) = label.pass_environment.invalid_pattern() else { return Ok(()) };
    let expected = "names of environment variables, or their beginnings with a * behind them: [\"MYCODE_*\"]";
    wrong("label.pass_environment", format!("{pattern:?}"), expected)
}

fn check_batch_options(label: &LabelSection) -> Result<(), Wrong> {
    if let Some(option) = label.batch_options.iter().find(|option| !is_option(option)) {
        let expected = "options of sbatch, each with its value in one piece: \"--partition=long\"";
        return wrong("label.batch_options", format!("{option:?}"), expected);
    }
    let another = |option: &&String| option.starts_with("--cluster") || option.starts_with("-M");
    if let Some(option) = label.batch_options.iter().find(another) {
        let expected =
            "jobs in the cluster of the host where labels are made: they would not be found in another";
        return wrong("label.batch_options", format!("{option:?}"), expected);
    }
    Ok(())
}

fn check_scratch(label: &LabelSection) -> Result<(), Wrong> {
    match &label.scratch {
        None if label.batch_system.is_some() => {
            let expected = "with label.batch_system, a directory that every node sees by the same name";
            wrong("label.scratch", "left out", expected)
        }
        // Labellers may be on other hosts, where the directory of the configuration is not.
        Some(scratch) if !scratch.is_absolute() => {
            wrong("label.scratch", scratch.display(), "an absolute path, such as \"/scratch\"")
        }
        _ => Ok(()),
    }
}

/// It becomes a line of a script.
fn is_option(text: &str) -> bool {
    text.starts_with('-') && !text.chars().any(char::is_control)
}

fn check_mixture(config: &Config) -> Result<(), Wrong> {
    let Config { campaign, calm, run, .. } = config;
    let one_by_one = campaign.mode == Mode::Reproducible && run.walks_per_round.get() == 1;
    if calm.update == UpdateProtocol::PerSeedStructure && !one_by_one {
        let expected = "mode = \"reproducible\" and run.walks_per_round = 1: the mixture can be restarted for each seed \
                        structure only if walks follow one another";
        return wrong("calm.update", "\"per_seed_structure\"", expected);
    }
    if calm.update != UpdateProtocol::Never && calm.artifact.is_none() {
        let expected = "the gmm_artifacts.npz of the model: an export alone has no scatter matrices and counts, so its \
                        mixture can be scored with but not updated (with update = \"never\" the artifact may be left out)";
        return wrong("calm.artifact", "left out", expected);
    }
    Ok(())
}

fn check_thermostat(config: &Config) -> Result<(), Wrong> {
    let thermostat = &config.walk.thermostat;
    if *thermostat == (ThermostatSettings::None {}) {
        let expected = "a thermostat: the bias heats a walk at constant energy";
        return wrong("walk.thermostat", "`none`", expected);
    }
    wrong_thermostat(thermostat, "walk").map_or(Ok(()), Err)
}

/// The first impossible setting of a thermostat in the table `section`.
pub fn wrong_thermostat(thermostat: &ThermostatSettings, section: &str) -> Option<Wrong> {
    let WrongSetting { key, found, expected } = thermostat.wrong()?;
    Some((format!("{section}.thermostat.{key}"), found.to_string(), expected.to_owned()))
}

fn check_min_distances(config: &Config) -> Result<(), Wrong> {
    let MinDistanceRule::PerPair(rule) = &config.guard.min_distances else { return Ok(()) };
    let is_wrong = |limit: f64| !(limit > 0.0 && limit <= MAX_MIN_DISTANCE);
    match rule.pairs.iter().find(|(_, limit)| is_wrong(**limit)) {
        Some((pair, limit)) => wrong(
            &format!("guard.min_distances.pairs.{pair}"),
            limit,
            format!("above 0, at most {MAX_MIN_DISTANCE} Å"),
        ),
        None => Ok(()),
    }
}

fn check_zbl(config: &Config) -> Result<(), Wrong> {
    let expected = "inner below outer, both 0 or above";
    let is_wrong = |inner: f64, outer: f64| !(0.0 <= inner && inner < outer && outer.is_finite());
    let found = |inner: f64, outer: f64| format!("inner {inner} and outer {outer}");
    match &config.guard.zbl {
        Some(ZblWindows::Uniform(ZblWindow { inner, outer })) if is_wrong(*inner, *outer) => {
            wrong("guard.zbl", found(*inner, *outer), expected)
        }
        Some(ZblWindows::PerPair(RadiiWindows { inner, outer, .. })) if is_wrong(*inner, *outer) => {
            wrong("guard.zbl", found(*inner, *outer), expected)
        }
        Some(ZblWindows::PerPair(RadiiWindows { pairs, .. })) => {
            match pairs.iter().find(|(_, window)| is_wrong(window.inner, window.outer)) {
                Some((pair, window)) => {
                    wrong(&format!("guard.zbl.pairs.{pair}"), found(window.inner, window.outer), expected)
                }
                None => Ok(()),
            }
        }
        _ => Ok(()),
    }
}

/// Names, and numbers that have the ranges of `[walk]`.
fn check_groups(config: &Config) -> Result<(), Wrong> {
    let mut names = HashSet::new();
    for (number, group) in config.walks.iter().enumerate() {
        let key = |name: &str| format!("walks.{number}.{name}");
        if group.name.trim().is_empty() || !names.insert(&group.name) {
            return wrong(&key("name"), format!("{:?}", group.name), "a name that no other group has");
        }
        if group.repeats.get() > MAX_REPEATS {
            return wrong(&key("repeats"), group.repeats, format!("at most {MAX_REPEATS}"));
        }
        let volumes = group.volume_ramps.iter().flat_map(|ramp| [ramp.from, ramp.to]);
        let all = [
            ("temperatures", "walk.temperature", group.temperatures.clone()),
            ("volume_ramps", "walk.volume_ramp.from", volumes.collect()),
            ("tau_values", "walk.tau", group.tau_values.clone()),
        ];
        for (name, of_walk, values) in all {
            let impossible =
                values.into_iter().find_map(|value| ranges::expected_instead(of_walk, value.get()));
            if let Some((found, expected)) = impossible {
                return wrong(&key(name), found, expected);
            }
        }
    }
    Ok(())
}

fn check_temperature(config: &Config) -> Result<(), Wrong> {
    let Config { walk, walks, guard, .. } = config;
    let highest = guard.max_temperature.get();
    let of_groups = walks.iter().enumerate().flat_map(|(number, group)| {
        group
            .temperatures
            .iter()
            .map(move |temperature| (format!("walks.{number}.temperatures"), temperature))
    });
    let mut all = [("walk.temperature".to_owned(), &walk.temperature)].into_iter().chain(of_groups);
    match all.find(|(_, temperature)| highest <= temperature.get()) {
        Some((key, temperature)) => {
            let expected = format!("more than {key} = {} K: every walk would end at once", temperature.get());
            wrong("guard.max_temperature", highest, expected)
        }
        None => Ok(()),
    }
}
