//! Rules between keys, which the types and ranges of single keys cannot express.

mod constant_pressure;
mod refit;

use std::collections::HashSet;

use atoms::MinDistanceRule;
use calm::rules::Positive;
use md::{BarostatSettings, ThermostatSettings, WrongSetting};
use orchestrator::selector::{CampaignMode, UpdateProtocol};
use potentials::{RadiiWindows, ZblWindow, ZblWindows};
use store::ServerUrl;
use workers::labeller::BatchSystem;

use self::constant_pressure::check_constant_pressure;
use self::refit::check_refit;
use super::error::InvalidValue;
use super::ranges;
use super::{Config, LabelSection, LaunchSection, NotifySection, QueueFull, StopSection};

/// Upper limit of the smallest allowed distance of a pair of elements, Å.
const MAX_MIN_DISTANCE: f64 = 10.0;

/// Largest number of walks under the same conditions.
const MAX_REPEATS: u32 = 1000;

/// Checks a configuration as a whole and returns all invalid values.
pub fn check(config: &Config) -> Vec<InvalidValue> {
    let checks = [
        check_mixture(config),
        check_python(config),
        check_norm_interval(config),
        check_thermostat(config),
        check_min_distances(config),
        check_zbl(config),
        check_groups(config),
        check_constant_pressure(config),
        check_temperature(config),
        check_largest_grade(config),
        check_store(config),
        check_queue(config),
        check_completion(config),
        check_budget(config),
        check_stop(config),
        check_stop_walks(config),
        check_notify(&config.notify),
        check_seed_structures(config),
    ];
    let of_sections =
        check_label(&config.label, config.launch.as_ref()).into_iter().chain(check_refit(config));
    checks.into_iter().filter_map(Result::err).chain(of_sections).collect()
}

fn check_seed_structures(config: &Config) -> Result<(), InvalidValue> {
    if config.seed_structures.files.is_empty() {
        return wrong("seed_structures.files", "an empty list", "at least one file with seed structures");
    }
    Ok(())
}

fn check_notify(notify: &NotifySection) -> Result<(), InvalidValue> {
    if notify.command.as_ref().is_some_and(|command| command.first().is_none_or(String::is_empty)) {
        return wrong("notify.command", "an empty command", "a program, and its arguments");
    }
    Ok(())
}

fn wrong(key: &str, found: impl ToString, expected: impl ToString) -> Result<(), InvalidValue> {
    Err((key.to_owned(), found.to_string(), expected.to_string()))
}

/// The URL must not contain a password, because the text of the configuration is stored in the database.
fn check_store(config: &Config) -> Result<(), InvalidValue> {
    let Some(store) = &config.run.store else { return Ok(()) };
    match store.parse::<ServerUrl>() {
        Ok(url) if url.has_password() => {
            let expected = "a URL without its password: set PGPASSWORD or use ~/.pgpass";
            wrong("run.store", format!("{url} with a password"), expected)
        }
        Ok(_) => Ok(()),
        Err(error) => wrong("run.store", error, "the URL of a PostgreSQL database"),
    }
}

/// The budget must suffice for the labels of one structure.
fn check_budget(config: &Config) -> Result<(), InvalidValue> {
    let least = config.labels_of_each();
    match config.budget.labels {
        Some(labels) if labels.get() < least => {
            let expected = format!("at least {least}: a structure and its control frame");
            wrong("budget.labels", labels, expected)
        }
        _ => Ok(()),
    }
}

/// Versions of the potential have errors on labels that they were not trained on.
fn check_stop(config: &Config) -> Result<(), InvalidValue> {
    let Some(least) = config.stop.min_improvement else { return Ok(()) };
    let expected = match &config.refit {
        None => "[refit]: without it, no version of the potential is trained",
        Some(refit) if refit.held_out == 0.0 && refit.test_sets.is_empty() => {
            "refit.held_out above 0, or refit.test_sets: the errors on these labels measure the improvement"
        }
        Some(_) => return Ok(()),
    };
    wrong("stop.min_improvement", least.get(), expected)
}

fn check_stop_walks(config: &Config) -> Result<(), InvalidValue> {
    let StopSection { walks, max_steps_without_structure, .. } = &config.stop;
    let walks = walks.as_deref().unwrap_or_default();
    let names: Vec<_> = config.walks.iter().map(|group| group.name.as_str()).collect();
    if let Some(unknown) = walks.iter().find(|name| !names.contains(&name.as_str())) {
        let expected = match names.is_empty() {
            true => "no such key: there are no groups of [[walks]]".to_owned(),
            false => format!("a group of [[walks]]: {}", names.join(", ")),
        };
        return wrong("stop.walks", format!("\"{unknown}\""), expected);
    }
    if !walks.is_empty() && max_steps_without_structure.is_none() {
        let expected = "stop.max_steps_without_structure, which it belongs to";
        return wrong("stop.walks", walks.join(", "), expected);
    }
    Ok(())
}

/// The length of the queue depends on the speed of the labellers, which is not reproducible.
fn check_queue(config: &Config) -> Result<(), InvalidValue> {
    if config.label.on_queue_full == QueueFull::Raise && config.campaign.mode == CampaignMode::Reproducible {
        let expected = "\"wait\", or mode = \"live\": with \"raise\", the collected structures depend on the speed of the labellers, \
                        which is not reproducible";
        return wrong("label.on_queue_full", "\"raise\"", expected);
    }
    Ok(())
}

/// The model of completion is learned from labels as they arrive, which depends on the speed of the labellers.
fn check_completion(config: &Config) -> Result<(), InvalidValue> {
    let Some(least) = config.collect.min_completion_probability else { return Ok(()) };
    if config.campaign.mode == CampaignMode::Reproducible {
        let expected = "mode = \"live\", or no such key: the probability is learned from labels as they arrive, and with it the collected \
                        structures depend on the speed of the labellers, which is not reproducible";
        return wrong("collect.min_completion_probability", least.get(), expected);
    }
    Ok(())
}

/// Checks the keys of `[label]` and `[launch]` alone and returns all invalid values.
pub fn check_label(label: &LabelSection, launch: Option<&LaunchSection>) -> Vec<InvalidValue> {
    let guard = label
        .guard
        .invalid_setting()
        .map(|(key, found, expected)| (key.to_owned(), found, expected.to_owned()));
    let checks = [
        check_pass_environment(label),
        check_batch_options(label),
        check_scratch(label),
        check_batch_system(label, launch),
    ];
    guard.into_iter().chain(checks.into_iter().filter_map(Result::err)).collect()
}

/// Checks the batch system that the configuration describes, and that there is one where labels need it.
fn check_batch_system(label: &LabelSection, launch: Option<&LaunchSection>) -> Result<(), InvalidValue> {
    match launch.and_then(|launch| launch.custom.as_ref()) {
        Some(custom) => match custom.invalid_setting() {
            Some((key, found, expected)) => wrong(&format!("launch.custom.{key}"), found, expected),
            None => Ok(()),
        },
        None if label.batch_system == Some(BatchSystem::Custom) => {
            let expected =
                "the table [launch.custom] beside it: configs/pbs.toml and configs/lsf.toml have one";
            wrong("label.batch_system", "\"custom\"", expected)
        }
        None => Ok(()),
    }
}

fn check_pass_environment(label: &LabelSection) -> Result<(), InvalidValue> {
    let Some(pattern) = label.pass_environment.invalid_pattern() else { return Ok(()) };
    let expected = "names of environment variables, or prefixes followed by *, such as [\"MYCODE_*\"]";
    wrong("label.pass_environment", format!("{pattern:?}"), expected)
}

fn check_batch_options(label: &LabelSection) -> Result<(), InvalidValue> {
    if let Some(option) = label.batch_options.first()
        && label.batch_system == Some(BatchSystem::Custom)
    {
        let expected =
            "no options with batch_system = \"custom\": write what they say into launch.custom.script";
        return wrong("label.batch_options", format!("{option:?}"), expected);
    }
    if let Some(option) = label.batch_options.iter().find(|option| !is_option(option)) {
        let expected = "options of sbatch, each with its value in one string, such as \"--partition=long\"";
        return wrong("label.batch_options", format!("{option:?}"), expected);
    }
    let another = |option: &&String| option.starts_with("--cluster") || option.starts_with("-M");
    if let Some(option) = label.batch_options.iter().find(another) {
        let expected = "no option for another cluster: submit jobs to the cluster of the labeller's host, which cannot query others";
        return wrong("label.batch_options", format!("{option:?}"), expected);
    }
    Ok(())
}

fn check_scratch(label: &LabelSection) -> Result<(), InvalidValue> {
    match &label.scratch {
        None if label.batch_system.is_some() => {
            let expected = "a directory that has the same path on every node: label.batch_system requires it";
            wrong("label.scratch", "left out", expected)
        }
        // Labellers may run on other hosts, which do not have the directory of the configuration.
        Some(scratch) if !scratch.is_absolute() => {
            wrong("label.scratch", scratch.display(), "an absolute path, such as \"/scratch\"")
        }
        _ => Ok(()),
    }
}

/// Whether the text is an option that can be a line of a job script.
fn is_option(text: &str) -> bool {
    text.starts_with('-') && !text.chars().any(char::is_control)
}

fn check_mixture(config: &Config) -> Result<(), InvalidValue> {
    let Config { campaign, calm, run, .. } = config;
    let one_by_one = campaign.mode == CampaignMode::Reproducible && run.walks_per_round.get() == 1;
    let restarted = match calm.update {
        UpdateProtocol::Cumulative | UpdateProtocol::Never => None,
        UpdateProtocol::PerSeedStructure => Some(("\"per_seed_structure\"", "seed structure")),
        UpdateProtocol::PerWalk => Some(("\"per_walk\"", "walk")),
    };
    if let Some((found, each)) = restarted.filter(|_| !one_by_one) {
        let expected = format!(
            "mode = \"reproducible\" and run.walks_per_round = 1: the mixture can be restarted for each {each} only if walks follow one \
             another"
        );
        return wrong("calm.update", found, expected);
    }
    if calm.update != UpdateProtocol::Never && calm.artifact.is_none() {
        let expected = "the gmm_artifacts.npz of the model: an export alone has no scatter matrices and counts, so its \
                        mixture can grade structures but cannot be updated (with update = \"never\" the artifact may be left out)";
        return wrong("calm.artifact", "left out", expected);
    }
    Ok(())
}

/// A program in Python has no mixture of its own.
fn check_python(config: &Config) -> Result<(), InvalidValue> {
    if config.potential.python.is_none() {
        return Ok(());
    }
    if config.calm.artifact.is_none() {
        let expected =
            "the artifact of a mixture for this model: build one with calmwalk calm build --model CONFIG";
        return wrong("calm.artifact", "left out", expected);
    }
    Ok(())
}

/// The steps between those that measure the norms save a gradient of models in Python, in walks that do not need the virial without bias.
fn check_norm_interval(config: &Config) -> Result<(), InvalidValue> {
    let (interval, averaged) = (config.walk.bias_norm_interval.get(), config.walk.bias_averaging_steps.get());
    let expected = match interval {
        1 => return Ok(()),
        _ if interval > averaged => {
            "at most walk.bias_averaging_steps: the average would follow single steps"
        }
        _ if config.potential.python.is_none() => {
            "1, or [potential.python]: for GRACE models calmwalk computes both gradients in one sweep"
        }
        _ if all_at_constant_pressure(config) => {
            "1, or no walk.barostat: at constant pressure each step needs the virial without bias"
        }
        _ => return Ok(()),
    };
    wrong("walk.bias_norm_interval", interval, expected)
}

fn all_at_constant_pressure(config: &Config) -> bool {
    let barostat = config.walk.barostat.is_some();
    if config.walks.is_empty() {
        return barostat;
    }
    config
        .walks
        .iter()
        .all(|group| group.volume_ramps.is_empty() && (barostat || !group.pressures.is_empty()))
}

fn check_thermostat(config: &Config) -> Result<(), InvalidValue> {
    let thermostat = &config.walk.thermostat;
    if *thermostat == (ThermostatSettings::None {}) {
        let expected = "a thermostat: the bias heats a walk at constant energy";
        return wrong("walk.thermostat", "`none`", expected);
    }
    wrong_thermostat(thermostat, "walk").map_or(Ok(()), Err)
}

/// The first impossible setting of a thermostat in the table `section`.
pub fn wrong_thermostat(thermostat: &ThermostatSettings, section: &str) -> Option<InvalidValue> {
    let WrongSetting { key, found, expected } = thermostat.wrong()?;
    Some((format!("{section}.thermostat.{key}"), found.to_string(), expected.to_owned()))
}

/// The first impossible setting of a barostat in the table `section`.
pub fn wrong_barostat(barostat: &BarostatSettings, section: &str) -> Option<InvalidValue> {
    let WrongSetting { key, found, expected } = barostat.wrong()?;
    Some((format!("{section}.barostat.{key}"), found.to_string(), expected.to_owned()))
}

fn check_min_distances(config: &Config) -> Result<(), InvalidValue> {
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

fn check_zbl(config: &Config) -> Result<(), InvalidValue> {
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

/// Checks the names of the groups, and their numbers against the ranges of `[walk]`.
fn check_groups(config: &Config) -> Result<(), InvalidValue> {
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
            ("start_volumes", "walk.start_volume", group.start_volumes.clone()),
            ("tau_values", "walk.tau", group.tau_values.clone()),
        ];
        let numbers =
            all.map(|(name, key, values)| (name, key, values.into_iter().map(Positive::get).collect()));
        let pressures = ("pressures", "walk.barostat.pressure", group.pressures.clone());
        for (name, of_walk, values) in numbers.into_iter().chain([pressures]) {
            let impossible =
                Vec::into_iter(values).find_map(|value| ranges::expected_instead(of_walk, value));
            if let Some((found, expected)) = impossible {
                return wrong(&key(name), found, expected);
            }
        }
    }
    Ok(())
}

fn check_largest_grade(config: &Config) -> Result<(), InvalidValue> {
    let threshold = config.collect.criterion.threshold();
    match config.guard.max_grade {
        Some(bound) if bound.get() <= threshold => {
            let expected = format!(
                "more than the threshold of collect.criterion, {threshold}: otherwise nothing is collected"
            );
            wrong("guard.max_grade", bound.get(), expected)
        }
        _ => Ok(()),
    }
}

fn check_temperature(config: &Config) -> Result<(), InvalidValue> {
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
            let expected = format!(
                "more than {key} = {} K; otherwise every walk ends at its first step",
                temperature.get()
            );
            wrong("guard.max_temperature", highest, expected)
        }
        None => Ok(()),
    }
}
