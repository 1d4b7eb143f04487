//! Overrides rules of the configuration with which a campaign started.

use std::str::FromStr;

use toml::{Table, Value};

use crate::config::{Config, impossible, user_message};
use crate::exit_status::CommandError;

/// Keys that affect the selector's decisions. Their effect on walks is recorded and does not change.
const KEYS: [&str; 13] = [
    "budget.labels",
    "calm.covariance_update",
    "calm.forgetting_alarm",
    "calm.max_mean_square_growth",
    "calm.on_forgetting",
    "calm.alpha_values",
    "calm.update",
    "collect.max_per_walk",
    "collect.max_per_seed_structure",
    "collect.max_structures",
    "collect.update_target",
    "collect.criterion",
    "guard.min_distances",
];

/// A key with another value, as `key=value`.
#[derive(Clone, Debug)]
pub struct RuleOverride {
    /// Dotted key: one of [`KEYS`] or a key below it.
    pub key: String,
    /// Its value.
    pub value: Value,
}

impl FromStr for RuleOverride {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (key, value) = text.split_once('=').ok_or("expected KEY=VALUE")?;
        let (key, value) = (key.trim().to_owned(), value.trim());
        if find_key(&key).is_none() {
            return Err(format!(
                "{key} cannot be replayed: expected a key that acts on the selector alone, {}",
                KEYS.join(", ")
            ));
        }
        Ok(Self { value: parse(value).map_err(|error| format!("{key} = {value}: {error}"))?, key })
    }
}

impl RuleOverride {
    /// Which of the [`KEYS`] it is or belongs to.
    pub fn base_key(&self) -> &'static str {
        find_key(&self.key).unwrap_or_default()
    }
}

impl RuleOverride {
    /// Name of the key in the decision log.
    pub fn rule(&self) -> &'static str {
        // Both keys limit the number of structures, and the log records one limit.
        if self.base_key() == "budget.labels" { "collect.max_structures" } else { self.base_key() }
    }
}

fn find_key(key: &str) -> Option<&'static str> {
    let is_in = |known: &&str| key == *known || key.strip_prefix(known).is_some_and(|k| k.starts_with('.'));
    KEYS.into_iter().find(is_in)
}

/// Parses a TOML value. A single word needs no quotes, since the shell removes them.
fn parse(value: &str) -> Result<Value, String> {
    let is_word = value.starts_with(|c: char| c.is_ascii_lowercase())
        && value.chars().all(|c| c.is_ascii_lowercase() || c == '_')
        && !["true", "false", "inf", "nan"].contains(&value);
    if is_word {
        return Ok(Value::String(value.to_owned()));
    }
    let mut table: Table = format!("value = {value}").parse().map_err(|error| user_message(&error))?;
    table.remove("value").ok_or_else(|| "expected a value".to_owned())
}

/// Parses the configuration `stored` and applies these overrides.
pub fn configuration(stored: &str, settings: &[RuleOverride]) -> Result<Config, CommandError> {
    let unreadable = |error: String| {
        CommandError::Input(format!(
            "the configuration in the campaign's database: {error}; replay it with the version that began it"
        ))
    };
    let mut table: Table = stored.parse().map_err(|error| unreadable(user_message(&error)))?;
    let mut config: Config = toml::from_str(stored).map_err(|error| unreadable(user_message(&error)))?;
    for RuleOverride { key, value } in settings {
        let wrong = |error: String| CommandError::Input(format!("--set {key}={value}: {error}"));
        set_key(&mut table, key, value.clone()).map_err(wrong)?;
        config = toml::from_str(&table.to_string()).map_err(|error| wrong(user_message(&error)))?;
    }
    let set = table.to_string();
    let mut wrong = impossible(&set).into_iter().chain(config.check());
    match wrong.next() {
        Some((key, found, expected)) => {
            Err(CommandError::Input(format!("--set: {key} is {found}; expected {expected}")))
        }
        None => Ok(config),
    }
}

fn set_key(table: &mut Table, key: &str, value: Value) -> Result<(), String> {
    let mut place = table;
    let (sections, name) = key.rsplit_once('.').unwrap_or(("", key));
    for section in sections.split('.') {
        let inside = place.entry(section).or_insert_with(|| Value::Table(Table::new()));
        place = inside.as_table_mut().ok_or_else(|| format!("{section} is not a table"))?;
    }
    place.insert(name.to_owned(), value);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn setting(text: &str) -> Result<RuleOverride, String> {
        text.parse()
    }

    fn configs(name: &str) -> String {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs").join(name);
        std::fs::read_to_string(path).unwrap()
    }

    #[test]
    fn keys_of_the_selector_are_taken_and_no_others() {
        let words = setting("calm.covariance_update=additive").unwrap();
        assert_eq!((&words.value, words.base_key()), (&Value::from("additive"), "calm.covariance_update"));
        let inside = setting("collect.criterion.threshold = 1.75").unwrap();
        assert_eq!((inside.value.as_float(), inside.base_key()), (Some(1.75), "collect.criterion"));
        assert_eq!(setting("calm.alpha_values=[0.5,1]").unwrap().value.as_array().unwrap().len(), 2);
        for (text, words) in [
            (
                "walk.tau=0.2",
                "walk.tau cannot be replayed: expected a key that acts on the selector alone, budget.l",
            ),
            ("collect.whenever=1", "collect.whenever cannot be replayed"),
            ("collect.max_structures", "expected KEY=VALUE"),
            ("collect.max_structures=", "collect.max_structures = : "),
            ("calm.alpha_values=[0.5", "calm.alpha_values = [0.5: "),
        ] {
            let error = setting(text).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
    }

    #[test]
    fn values_are_checked_like_those_of_a_configuration() {
        let text = configs("aluminium.toml");
        let with = |texts: &[&str]| {
            let settings: Vec<_> = texts.iter().map(|text| setting(text).unwrap()).collect();
            configuration(&text, &settings)
        };
        assert_eq!(with(&["collect.max_per_walk=7"]).unwrap().collect.max_per_walk.get(), 7);
        let rule =
            with(&["collect.criterion={ rule = \"maximum_grade\" }", "collect.criterion.threshold=2.5"]);
        assert!(rule.unwrap().collect.criterion.is_met(&[2.6]));
        for (texts, words) in [
            (
                &["collect.max_per_walk=0"][..],
                "--set collect.max_per_walk=0: invalid value: integer `0`, expected a whole",
            ),
            (&["collect.criterion.threshold=-1.0"], "expected a finite number above 0"),
            (&["collect.criterion.treshold=1.0"], "unknown key `treshold`"),
            (&["calm.covariance_update=conves"], "did you mean `convex`?"),
            (&["collect.max_per_walk.x=1"], "invalid type: map, expected a whole number"),
        ] {
            let Err(CommandError::Input(error)) = with(texts) else { panic!("{texts:?} are taken") };
            assert!(error.contains(words), "{error}");
        }
    }
}
