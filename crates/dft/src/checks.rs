//! Checks of single settings.

use std::fmt::Display;

use crate::SetupError;

fn wrong(key: &'static str, found: impl Display, expected: String) -> Result<(), SetupError> {
    Err(SetupError::Setting { key, found: found.to_string(), expected })
}

/// Requires a positive finite number.
pub(crate) fn positive(key: &'static str, value: f64) -> Result<(), SetupError> {
    match value.is_finite() && value > 0.0 {
        true => Ok(()),
        false => wrong(key, value, "a number above 0".into()),
    }
}

/// Requires at least `least`.
pub(crate) fn at_least<T: PartialOrd + Display>(
    key: &'static str,
    value: T,
    least: T,
) -> Result<(), SetupError> {
    match value >= least {
        true => Ok(()),
        false => wrong(key, value, format!("at least {least}")),
    }
}
