//! Settings with impossible values.

/// A setting of a thermostat that has an impossible value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WrongSetting {
    /// Dotted key below that of the thermostat.
    pub key: &'static str,
    /// Its value.
    pub found: f64,
    /// What is possible.
    pub expected: &'static str,
}

impl WrongSetting {
    pub(crate) fn unless_positive(key: &'static str, found: f64) -> Option<Self> {
        (!is_positive(found)).then_some(Self { key, found, expected: "a finite number above 0" })
    }
}

pub(crate) fn is_positive(x: f64) -> bool {
    x.is_finite() && x > 0.0
}
