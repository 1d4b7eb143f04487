//! The rules of `[refit]`.

use std::collections::HashSet;

use orchestrator::selector::{CampaignMode, UpdateProtocol};

use super::wrong;
use crate::config::error::InvalidValue;
use crate::config::{
    CommandRefit, Config, ControlFrames, NativeRefit, RefitMethod, RefitSection, RefitStart, TestSetSection,
};

/// Names of the data sets that every version is judged by; no test set may have them.
const OWN_SETS: [&str; 3] = ["held_out", "replay", "since"];
/// Name of the comparison with control frames.
const CONTROL: &str = "control";

/// Everything that is wrong with `[refit]`, and with other sections because of it.
pub fn check_refit(config: &Config) -> Vec<InvalidValue> {
    let Some(refit) = &config.refit else { return Vec::new() };
    let mut checks = vec![
        check_update(config),
        check_artifact(config),
        check_replay(refit),
        check_after_time(config, refit),
        check_share("refit.held_out", refit.held_out),
        check_names("test_sets", &refit.test_sets, &OWN_SETS),
        check_names("comparisons", &refit.comparisons, &[CONTROL]),
        check_comparisons(config, refit),
    ];
    match &refit.method {
        RefitMethod::Native(native) => checks.extend(check_native(native)),
        RefitMethod::Command(command) => checks.push(check_program(command)),
    }
    checks.into_iter().filter_map(Result::err).collect()
}

/// The mixture of each version learns what walks have found.
fn check_update(config: &Config) -> Result<(), InvalidValue> {
    if config.calm.update == UpdateProtocol::Never {
        let expected = "another value: with [refit], the mixture of each version is updated by the structures that walks find";
        return wrong("calm.update", "\"never\"", expected);
    }
    Ok(())
}

/// With other values of `calm.update`, `calm.artifact` is required without `[refit]` too.
fn check_artifact(config: &Config) -> Result<(), InvalidValue> {
    if config.calm.update == UpdateProtocol::Never && config.calm.artifact.is_none() {
        let expected = "the gmm_artifacts.npz of the model: [refit] needs a mixture that can be updated";
        return wrong("calm.artifact", "left out", expected);
    }
    Ok(())
}

fn check_replay(refit: &RefitSection) -> Result<(), InvalidValue> {
    if refit.replay.is_empty() {
        let expected = "at least one file with labelled structures that the potential knows";
        return wrong("refit.replay", "an empty list", expected);
    }
    Ok(())
}

fn check_after_time(config: &Config, refit: &RefitSection) -> Result<(), InvalidValue> {
    match refit.after_time {
        Some(time) if config.campaign.mode == CampaignMode::Reproducible => {
            let expected = "mode = \"live\", or refit.after_structures in its place: what depends on time is not reproducible";
            wrong("refit.after_time", time, expected)
        }
        _ => Ok(()),
    }
}

fn check_share(key: &str, share: f64) -> Result<(), InvalidValue> {
    if !(0.0..1.0).contains(&share) {
        return wrong(key, share, "a number from 0 up to, not including, 1");
    }
    Ok(())
}

/// Names in a list of files that are plain, and that neither another entry nor calmwalk itself has.
fn check_names(key: &str, sets: &[TestSetSection], own: &[&str]) -> Result<(), InvalidValue> {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || ['_', '-'].contains(&letter);
    let mut names: HashSet<&str> = own.iter().copied().collect();
    for (number, set) in sets.iter().enumerate() {
        let name = set.name.as_str();
        if name.is_empty() || !name.chars().all(is_plain) || !names.insert(name) {
            let expected = format!(
                "a name of letters, digits, _ and - that no other set has; calmwalk itself uses {}",
                own.join(", ")
            );
            return wrong(&format!("refit.{key}.{number}.name"), format!("{name:?}"), expected);
        }
    }
    Ok(())
}

/// Models are compared that begin with the same weights and have the same training.
fn check_comparisons(config: &Config, refit: &RefitSection) -> Result<(), InvalidValue> {
    let (key, found) = match (refit.control_frames, refit.comparisons.len()) {
        (ControlFrames::Train, 0) => return Ok(()),
        (ControlFrames::Compare, _) => ("refit.control_frames", "\"compare\"".to_owned()),
        (ControlFrames::Train, number) => ("refit.comparisons", format!("a list of {number}")),
    };
    if refit.control_frames == ControlFrames::Compare && !config.campaign.control {
        return wrong(key, found, "\"train\": without campaign.control there are no control frames");
    }
    if refit.start != RefitStart::First || !matches!(refit.method, RefitMethod::Native(_)) {
        let expected = "refit.start = \"first\" and refit.method = { native = … } beside it: the compared models must start from \
                        the same weights and have the same training";
        return wrong(key, found, expected);
    }
    Ok(())
}

fn check_native(native: &NativeRefit) -> Vec<Result<(), InvalidValue>> {
    let average = native.average.map(|average| check_share("refit.method.native.average", average));
    let mut checks = vec![
        check_share("refit.method.native.validation_share", native.validation_share),
        check_last_learning_rate(native),
        check_patience(native),
        check_weights(native),
    ];
    checks.extend(average);
    checks
}

fn check_last_learning_rate(native: &NativeRefit) -> Result<(), InvalidValue> {
    let first = native.first_learning_rate();
    match native.min_learning_rate {
        Some(last) if !(0.0..=first).contains(&last) => {
            let expected = format!("0 to refit.method.native.learning_rate = {first}");
            wrong("refit.method.native.min_learning_rate", last, expected)
        }
        _ => Ok(()),
    }
}

fn check_weights(native: &NativeRefit) -> Result<(), InvalidValue> {
    let weights = [
        ("energy_weight", native.energy_weight),
        ("force_weight", native.force_weight),
        ("stress_weight", native.stress_weight),
    ];
    for (name, weight) in weights {
        if let Some(weight) = weight.filter(|weight| !(weight.is_finite() && *weight >= 0.0)) {
            return wrong(&format!("refit.method.native.{name}"), weight, "a number, 0 or more");
        }
    }
    Ok(())
}

fn check_patience(native: &NativeRefit) -> Result<(), InvalidValue> {
    match native.patience {
        Some(patience) if native.validation_share == 0.0 => {
            let expected =
                "refit.method.native.validation_share above 0: without validation there is no loss to watch";
            wrong("refit.method.native.patience", patience, expected)
        }
        _ => Ok(()),
    }
}

fn check_program(command: &CommandRefit) -> Result<(), InvalidValue> {
    if command.program.first().is_none_or(String::is_empty) {
        return wrong("refit.method.command.program", "an empty command", "a program, and its arguments");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::config::demo_without_refit;

    const REPLAY: &str = "replay = [\"r.extxyz\"]";

    /// What is wrong with a configuration; empty if nothing is.
    fn errors(text: &str) -> String {
        let loaded = Config::from_draft(Path::new("c.toml"), text.to_owned());
        loaded.err().map(|error| error.to_string()).unwrap_or_default()
    }

    /// The demo with these lines in `[refit]`.
    fn with(lines: &str) -> String {
        format!("{}\n[refit]\n{lines}\n", demo_without_refit())
    }

    /// `file:line` of the first line that begins with this.
    fn at(text: &str, beginning: &str) -> String {
        let number = text.lines().position(|line| line.starts_with(beginning));
        format!("c.toml:{}:", 1 + number.unwrap_or_else(|| panic!("no line {beginning}")))
    }

    /// Each line is refused at its place with these words.
    fn refused(lines: &[(&str, &str)]) {
        for (line, expected) in lines {
            let replay = if line.starts_with("replay = ") { "" } else { REPLAY };
            let text = with(&format!("{replay}\n{line}"));
            let found = errors(&text);
            assert!(found.starts_with(&at(&text, line)), "{line}: {found}");
            assert!(found.contains(expected), "{found}\nexpected {expected}");
        }
    }

    #[test]
    fn a_refit_with_all_its_keys_is_accepted() {
        assert_eq!(errors(&with(REPLAY)), "");
        let native = "epochs = 5, batch_size = 4, learning_rate = 1e-4, min_learning_rate = 1e-4, loss = \"paper\", \
                      freeze = [\"shift\"], patience = 2, average = 0.99, validation_share = 0.2, energy_weight = 20.0, \
                      force_weight = 100.0, stress_weight = 0.0, huber_delta = 0.02, optimiser = \"soap\"";
        let sets = "[[refit.test_sets]]\nname = \"liquid-1\"\nfile = \"l.extxyz\"\n[[refit.test_sets]]\nname = \"seeds\"\n\
                    file = \"s.extxyz\"";
        let all = format!(
            "{REPLAY}\nreplay_weight = 0.02\nafter_structures = 50\nafter_time = \"24h\"\nmax_versions = 2\nheld_out = 0\n\
             start = \"first\"\ncontrol_frames = \"compare\"\ncomparisons = [{{ name = \"cold\", file = \"c.extxyz\" }}]\n\
             max_replay_error_ratio = 2\nmax_held_out_error_ratio = 1.1\nmax_attempts = 2\nthreads = 2\n\
             method = {{ native = {{ {native} }} }}\n{sets}"
        );
        let live = with(&all).replacen("# mode = \"reproducible\"", "mode = \"live\"", 1);
        assert_eq!(errors(&live), "");
        let command = "method = { command = { program = [\"./train.sh\"], time_limit = \"1day\" } }";
        assert_eq!(errors(&with(&format!("{REPLAY}\n{command}"))), "");
    }

    #[test]
    fn each_key_has_its_rule() {
        refused(&[
            ("replay = []", "refit.replay is an empty list; expected at least one file"),
            (
                "after_time = \"2h\"",
                "refit.after_time is 2h; expected mode = \"live\", or refit.after_structures in its place",
            ),
            ("held_out = 1.0", "refit.held_out is 1; expected a number from 0 up to, not including, 1"),
            ("held_out = -0.1", "refit.held_out is -0.1; expected a number from 0"),
            ("max_versions = 0", "refit.max_versions: "),
            ("max_versions = 20000", "refit.max_versions is 20000; expected at most 10000"),
            (
                "control_frames = \"compare\"",
                "refit.control_frames is \"compare\"; expected refit.start = \"first\" and refit.method",
            ),
            (
                "comparisons = [{ name = \"cold\", file = \"c\" }]",
                "refit.comparisons is a list of 1; expected refit.start = \"first\"",
            ),
            ("replay_weight = -1.0", "found -1, expected a finite number above 0"),
            ("max_replay_error_ratio = 0", "found 0, expected a finite number above 0"),
            ("threads = 5000", "refit.threads is 5000; expected at most 1024"),
        ]);
    }

    #[test]
    fn each_key_of_a_method_has_its_rule() {
        refused(&[
            (
                "method = { native = { validation_share = 1.5 } }",
                "refit.method.native.validation_share is 1.5; expected a number from 0 up to",
            ),
            (
                "method = { native = { average = 1.0 } }",
                "refit.method.native.average is 1; expected a number from 0 up to",
            ),
            (
                "method = { native = { min_learning_rate = 0.1 } }",
                "refit.method.native.min_learning_rate is 0.1; expected 0 to refit.method.native.learning_rate = 0.05",
            ),
            (
                "method = { native = { min_learning_rate = -1.0 } }",
                "refit.method.native.min_learning_rate is -1; expected 0 to",
            ),
            (
                "method = { native = { patience = 5, validation_share = 0.0 } }",
                "refit.method.native.patience is 5; expected refit.method.native.validation_share above 0",
            ),
            (
                "method = { native = { force_weight = -1.0 } }",
                "refit.method.native.force_weight is -1; expected a number, 0 or more",
            ),
            (
                "method = { native = { learning_rate = 2.0 } }",
                "refit.method.native.learning_rate is 2; expected at most 1",
            ),
            (
                "method = { command = { program = [] } }",
                "refit.method.command.program is an empty command; expected a program",
            ),
            (
                "method = { command = { program = [\"\"] } }",
                "refit.method.command.program is an empty command",
            ),
            (
                "method = { command = { program = [\"p\"], time_limit = \"10ms\" } }",
                "refit.method.command.time_limit is 10ms; expected 1s to 1year",
            ),
        ]);
    }

    #[test]
    fn test_sets_have_names_of_their_own() {
        for name in ["", "a b", "a/b", "é", "held_out", "replay", "since"] {
            let line = format!("test_sets = [{{ name = \"{name}\", file = \"t\" }}]");
            let expected = format!("refit.test_sets.0.name is \"{name}\"; expected a name of letters");
            refused(&[(line.as_str(), expected.as_str())]);
        }
        let control = "start = \"first\"\ncomparisons = [{ name = \"control\", file = \"c\" }]";
        let found = errors(&with(&format!("{REPLAY}\n{control}")));
        assert!(
            found.contains("refit.comparisons.0.name is \"control\"; expected a name of letters"),
            "{found}"
        );
        let twice = "[[refit.test_sets]]\nname = \"a\"\nfile = \"t\"\n";
        let text = with(&format!("{REPLAY}\n{twice}{twice}"));
        let found = errors(&text);
        let second = text.lines().count();
        let expected = format!("c.toml:{}: refit.test_sets.1.name is \"a\"; expected", second - 2);
        assert!(found.starts_with(&expected), "{found}\nexpected {expected}");
    }

    #[test]
    fn names_that_are_nearly_right_get_a_hint() {
        refused(&[
            ("thread = 2", "did you mean `threads`?"),
            ("epochs = 5", "it belongs in [refit.method.native]"),
            ("method = { nativ = {} }", "did you mean `native`?"),
            ("method = { native = { epoch = 5 } }", "did you mean `epochs`?"),
            ("method = { native = { loss = \"dmo\" } }", "did you mean `demo`?"),
        ]);
        let found = errors(&with("after_structures = 5"));
        assert!(found.contains("missing key `replay`"), "{found}");
    }

    #[test]
    fn the_mixture_must_be_one_that_is_updated() {
        let text = with(REPLAY).replacen("# update = \"cumulative\"", "update = \"never\"", 1);
        let found = errors(&text);
        assert!(found.starts_with(&at(&text, "update = ")), "{found}");
        assert!(found.contains("calm.update is \"never\"; expected another value: with [refit]"), "{found}");
        let text = text.replacen("\nartifact = ", "\n# artifact = ", 1);
        let found = errors(&text);
        let expected =
            format!("{} calm.artifact is left out; expected the gmm_artifacts", at(&text, "[calm]"));
        assert!(found.contains(&expected) && found.contains("calm.update is \"never\""), "{found}");
        // Without a refit, both are allowed.
        let without = text.split("\n[refit]").next().unwrap();
        assert_eq!(errors(without), "");
    }
}
