//! Numbers of which some values are impossible.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A finite number above zero.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "f64", into = "f64")]
#[schemars(extend("exclusiveMinimum" = 0))]
pub struct Positive(pub(crate) f64);

/// A number above 0 and at most 1.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "f64", into = "f64")]
#[schemars(extend("exclusiveMinimum" = 0, "maximum" = 1))]
pub struct Fraction(pub(super) f64);

/// The values of α to try: ascending, each above 0 and at most 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "Vec<f64>", into = "Vec<f64>")]
#[schemars(extend("minItems" = 1, "items" = { "type": "number", "exclusiveMinimum": 0, "maximum": 1 }))]
pub struct AlphaValues(pub(super) Vec<f64>);

/// A setting out of range.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RuleError {
    /// Not a positive number.
    #[error("found {0}, expected a finite number above 0")]
    NotPositive(f64),
    /// Not a fraction.
    #[error("found {0}, expected a number above 0 and not above 1")]
    NotFraction(f64),
    /// Not a valid list of α.
    #[error("found α = {0:?}, expected at least one value, ascending, each above 0 and not above 1")]
    NotLadder(Vec<f64>),
}

impl Positive {
    /// The number itself.
    pub fn get(self) -> f64 {
        self.0
    }
}

impl Fraction {
    pub(crate) const FIFTH: Self = Self(0.2);

    /// The number itself.
    pub fn get(self) -> f64 {
        self.0
    }
}

impl AlphaValues {
    /// The values, ascending.
    pub fn values(&self) -> &[f64] {
        &self.0
    }
}

impl TryFrom<f64> for Positive {
    type Error = RuleError;
    fn try_from(found: f64) -> Result<Self, RuleError> {
        if found.is_finite() && found > 0.0 { Ok(Self(found)) } else { Err(RuleError::NotPositive(found)) }
    }
}

impl TryFrom<f64> for Fraction {
    type Error = RuleError;
    fn try_from(found: f64) -> Result<Self, RuleError> {
        if found > 0.0 && found <= 1.0 { Ok(Self(found)) } else { Err(RuleError::NotFraction(found)) }
    }
}

impl TryFrom<Vec<f64>> for AlphaValues {
    type Error = RuleError;
    fn try_from(found: Vec<f64>) -> Result<Self, RuleError> {
        let within = found.iter().all(|&alpha| alpha > 0.0 && alpha <= 1.0);
        if !found.is_empty() && within && found.is_sorted_by(|a, b| a < b) {
            Ok(Self(found))
        } else {
            Err(RuleError::NotLadder(found))
        }
    }
}

impl From<Positive> for f64 {
    fn from(number: Positive) -> f64 {
        number.0
    }
}

impl From<Fraction> for f64 {
    fn from(number: Fraction) -> f64 {
        number.0
    }
}

impl From<AlphaValues> for Vec<f64> {
    fn from(values: AlphaValues) -> Vec<f64> {
        values.0
    }
}
