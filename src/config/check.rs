//! The rules of a configuration that no single value can check.

use orchestrator::selector::{Mode, UpdateProtocol};
use store::ServerUrl;
use workers::settings::ThermostatKind;

use super::{Config, LabelSection, NotifySection, QueueFull};

/// Signs of life are seconds apart.
const LEAST_SILENCE: f64 = 5.0;
/// Longer Nosé–Hoover chains than this are a mistake.
const LONGEST_CHAIN: usize = 100;

/// A value that does not go: its key, what was found, what was expected.
pub type Wrong = (&'static str, String, String);

/// Checks a configuration as a whole; the first thing that is wrong.
pub fn check(config: &Config) -> Result<(), Wrong> {
    check_limits(config)?;
    check_mixture(config)?;
    check_thermostat(config)?;
    check_guard(config)?;
    check_store(config)?;
    check_queue(config)?;
    check_budget(config)?;
    check_label(&config.label)?;
    check_notify(&config.notify)?;
    if config.seeds.files.is_empty() {
        return wrong("seeds.files", "an empty list", "at least one file with seed structures");
    }
    Ok(())
}

fn check_notify(notify: &NotifySection) -> Result<(), Wrong> {
    if notify.command.as_ref().is_some_and(|command| command.first().is_none_or(String::is_empty)) {
        return wrong("notify.command", "an empty command", "a program, and its arguments");
    }
    Ok(())
}

fn wrong(key: &'static str, found: impl ToString, expected: impl ToString) -> Result<(), Wrong> {
    Err((key, found.to_string(), expected.to_string()))
}

/// Larger values than these are slips of the pen, and some would exhaust the machine.
fn check_limits(config: &Config) -> Result<(), Wrong> {
    let Config { walk, collect, guard, run, .. } = config;
    let ramp = walk.volume_ramp.map_or(0.0, |ramp| ramp.from.get().max(ramp.to.get()));
    let most_steps = 1e12;
    let limits = [
        ("walk.temperature", walk.temperature.get(), 1e6),
        ("walk.steps", walk.steps.get() as f64, most_steps),
        ("walk.equilibration", walk.equilibration as f64, most_steps),
        ("walk.tau", walk.tau.get(), 1e3),
        ("walk.time_step", walk.time_step.map_or(0.0, |time_step| time_step.get()), 100.0),
        ("walk.volume_ramp", ramp, 1e3),
        ("walk.average_steps", walk.average_steps.get() as f64, most_steps),
        ("walk.skin", walk.skin.get(), 10.0),
        ("collect.gap", collect.gap as f64, most_steps),
        ("collect.declined_gap", collect.declined_gap.get() as f64, most_steps),
        ("collect.declined_features_mb", collect.declined_features_mb as f64, 1e9),
        ("guard.checkpoint_interval", guard.checkpoint_interval.get() as f64, most_steps),
        ("notify.stall", config.notify.stall.get(), 1e6),
        ("notify.time_limit", config.notify.time_limit.get(), 86_400.0),
        ("run.walkers", run.walkers as f64, 1024.0),
        ("run.threads", run.threads.get() as f64, 256.0),
        ("run.silence_limit", run.silence_limit.get(), 1e6),
        ("run.agent_silence_limit", run.agent_silence_limit.get(), 1e6),
        ("run.turn_steps", run.turn_steps.get() as f64, most_steps),
    ];
    let silence = run.silence_limit.get();
    if silence < LEAST_SILENCE {
        return wrong("run.silence_limit", silence, format!("at least {LEAST_SILENCE} s"));
    }
    at_most(&limits)
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
    if config.label.queue_full == QueueFull::Raise && config.campaign.mode == Mode::Reproducible {
        let expected = "\"wait\", or mode = \"live\": what is collected would depend on how fast labels are made, and a \
                        reproducible campaign must not";
        return wrong("label.queue_full", "\"raise\"", expected);
    }
    Ok(())
}

/// What can be said of labels without the rest.
pub fn check_label(label: &LabelSection) -> Result<(), Wrong> {
    at_most(&[
        ("label.slots", label.slots as f64, 1024.0),
        ("label.lease", f64::from(label.lease.get()), 86_400.0),
        ("label.cores", f64::from(label.cores.get()), 4096.0),
        ("label.time_limit", label.time_limit.get(), 1e8),
        ("label.memory", label.memory.map_or(0.0, |memory| memory.get()), 1e6),
    ])?;
    if let Some((key, found, expected)) = label.guard.fault() {
        return wrong(key, found, expected);
    }
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

/// Keys with what was found and the largest that makes sense.
fn at_most(limits: &[(&'static str, f64, f64)]) -> Result<(), Wrong> {
    match limits.iter().find(|(_, found, limit)| found > limit) {
        Some((key, found, limit)) => wrong(key, found, format!("at most {limit}")),
        None => Ok(()),
    }
}

fn check_mixture(config: &Config) -> Result<(), Wrong> {
    let Config { campaign, calm, run, .. } = config;
    let one_by_one = campaign.mode == Mode::Reproducible && run.walks_per_round.get() == 1;
    if calm.update == UpdateProtocol::Restarted && !one_by_one {
        let expected = "mode = \"reproducible\" and run.walks_per_round = 1: the mixture can be restarted for each seed \
                        structure only if walks follow one another";
        return wrong("calm.update", "\"restarted\"", expected);
    }
    if calm.update != UpdateProtocol::Never && calm.artifact.is_none() {
        let expected = "the gmm_artifacts.npz of the model: an export alone has no scatter matrices and counts, so its \
                        mixture can be scored with but not updated (with update = \"never\" the artifact may be left out)";
        return wrong("calm.artifact", "left out", expected);
    }
    Ok(())
}

fn check_thermostat(config: &Config) -> Result<(), Wrong> {
    let (name, number) = match config.walk.thermostat {
        ThermostatKind::Langevin { friction } => ("friction", friction),
        ThermostatKind::NoseHoover { chain_length, .. } if !(1..=LONGEST_CHAIN).contains(&chain_length) => {
            let found = format!("chain_length {chain_length}");
            return wrong("walk.thermostat", found, format!("1 to {LONGEST_CHAIN}"));
        }
        ThermostatKind::NoseHoover { relaxation_time, .. } => ("relaxation_time", relaxation_time),
    };
    if number.is_finite() && number > 0.0 {
        return Ok(());
    }
    wrong("walk.thermostat", format!("{name} {number}"), "a finite number above 0")
}

fn check_guard(config: &Config) -> Result<(), Wrong> {
    let Config { walk, guard, .. } = config;
    if let Some(zbl) = guard.zbl
        && zbl.inner >= zbl.outer
    {
        let found = format!("inner {} and outer {}", zbl.inner.get(), zbl.outer.get());
        return wrong("guard.zbl", found, "inner below outer");
    }
    let (highest, temperature) = (guard.highest_temperature.get(), walk.temperature.get());
    if highest <= temperature {
        let expected = format!("more than walk.temperature = {temperature} K: every walk would end at once");
        return wrong("guard.highest_temperature", highest, expected);
    }
    Ok(())
}
