//! Filters on structures, such as `gamma > 2 and element = Mo`. docs/export.md describes the language.

mod parse;
#[cfg(test)]
mod tests;

use std::fmt;
use std::str::FromStr;

use atoms::Species;
use wire::WalkConditions;

pub use parse::FilterError;

/// Properties of a structure. A comparison with a missing property is false.
#[derive(Clone, Debug, Default)]
pub struct StructureProperties<'a> {
    /// Largest γ under the original mixture.
    pub gamma: Option<f64>,
    /// Largest γ under the current mixture: the selector's at the decision, or that of a walk's walker.
    pub gamma_current: Option<f64>,
    /// Largest γ_nbr under the original mixture.
    pub gamma_nbr: Option<f64>,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// Kinetic temperature, K.
    pub kinetic_temperature: Option<f64>,
    /// Conditions of the walk.
    pub conditions: Option<&'a WalkConditions>,
    /// Walk.
    pub walk: Option<u32>,
    /// Step, equilibration included.
    pub step: Option<u64>,
    /// Version of the mixture after the decision.
    pub mixture_version: Option<u64>,
    /// Energy of the label, eV.
    pub energy: Option<f64>,
    /// Largest force of the label, eV/Å.
    pub max_force: Option<f64>,
    /// Names of the retry adjustments with which the label was made.
    pub retry_adjustments: Option<&'a [String]>,
    /// Number of fragments ([`atoms::fragments`]).
    pub fragments: Option<usize>,
    /// The element of each atom. Empty if unknown.
    pub species: &'a [Species],
    /// `biased`, `control` or `imported`.
    pub origin: &'a str,
    /// Name of the seed structure.
    pub seed_structure: Option<&'a str>,
}

/// A filter expression.
#[derive(Clone, Debug, PartialEq)]
pub enum StructureFilter {
    /// Compares a number.
    Number(NumberField, ComparisonOperator, f64),
    /// Whether a text equals (`true`) or differs from (`false`) a value.
    Text(TextField, bool, String),
    /// Negation.
    Not(Box<StructureFilter>),
    /// Conjunction.
    And(Box<StructureFilter>, Box<StructureFilter>),
    /// Disjunction.
    Or(Box<StructureFilter>, Box<StructureFilter>),
}

/// Comparison operators for numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ComparisonOperator {
    /// `=`
    Equal,
    /// `!=`
    Different,
    /// `<`
    Below,
    /// `<=`
    AtMost,
    /// `>`
    Above,
    /// `>=`
    AtLeast,
}

macro_rules! names {
    ($(#[$doc:meta])* $type:ident { $($variant:ident $name:literal),* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[allow(missing_docs)]
        pub enum $type { $($variant),* }

        impl $type {
            /// Every variant with its name.
            pub const ALL: &[(Self, &str)] = &[$((Self::$variant, $name)),*];

            fn name(self) -> &'static str {
                match self { $(Self::$variant => $name),* }
            }
        }
    };
}

names! {
    /// Numeric properties.
    NumberField {
        Gamma "gamma", GammaCurrent "gamma_current", GammaNbr "gamma_nbr", RelativeVolume "relative_volume", Temperature "temperature",
        KineticTemperature "kinetic_temperature", Tau "tau", Version "version", Walk "walk", Step "step",
        MixtureVersion "mixture_version", Atoms "atoms", Energy "energy", EnergyPerAtom "energy_per_atom",
        MaxForce "max_force", Fragments "fragments"
    }
}

names! {
    /// Text properties.
    TextField {
        Element "element", Origin "origin", SeedStructure "seed_structure", Group "group", RetryAdjustment "retry_adjustment"
    }
}

impl StructureFilter {
    /// Whether a structure passes the filter.
    pub fn matches(&self, properties: &StructureProperties<'_>) -> bool {
        match self {
            Self::Number(field, comparison, value) => {
                properties.number(*field).is_some_and(|number| comparison.holds(number, *value))
            }
            Self::Text(field, wanted, value) => {
                properties.is_text(*field, value).is_some_and(|found| found == *wanted)
            }
            Self::Not(condition) => !condition.matches(properties),
            Self::And(left, right) => left.matches(properties) && right.matches(properties),
            Self::Or(left, right) => left.matches(properties) || right.matches(properties),
        }
    }
}

impl StructureFilter {
    /// The walk that all structures are from that pass the filter; `None` if it allows several.
    pub fn only_walk(&self) -> Option<u32> {
        match self {
            Self::Number(NumberField::Walk, ComparisonOperator::Equal, number) => {
                let walk = *number as u32;
                (f64::from(walk) == *number).then_some(walk)
            }
            Self::And(left, right) => left.only_walk().or_else(|| right.only_walk()),
            _ => None,
        }
    }

    /// Limits that follow from the filter, both inclusive: a structure that passes has this property, not below the first and not above
    /// the second. `None`: no limit. The filter may be narrower.
    pub fn limits(&self, of: NumberField) -> [Option<f64>; 2] {
        use ComparisonOperator::{Above, AtLeast, AtMost, Below, Different, Equal};
        let both = |a: &Self, b: &Self| (a.limits(of), b.limits(of));
        let choose = |a: Option<f64>, b: Option<f64>, choose: fn(f64, f64) -> f64| match (a, b) {
            (Some(a), Some(b)) => Some(choose(a, b)),
            (a, b) => a.or(b),
        };
        match self {
            Self::Number(field, comparison, value) if *field == of => match comparison {
                Equal => [Some(*value); 2],
                Above | AtLeast => [Some(*value), None],
                Below | AtMost => [None, Some(*value)],
                Different => [None; 2],
            },
            Self::And(left, right) => {
                let ([low_a, high_a], [low_b, high_b]) = both(left, right);
                [choose(low_a, low_b, f64::max), choose(high_a, high_b, f64::min)]
            }
            Self::Or(left, right) => {
                let ([low_a, high_a], [low_b, high_b]) = both(left, right);
                [low_a.zip(low_b).map(|(a, b)| a.min(b)), high_a.zip(high_b).map(|(a, b)| a.max(b))]
            }
            Self::Number(..) | Self::Text(..) | Self::Not(_) => [None; 2],
        }
    }

    /// The property names in the expression, in order.
    pub fn names(&self) -> Vec<&'static str> {
        match self {
            Self::Number(field, ..) => vec![field.name()],
            Self::Text(field, ..) => vec![field.name()],
            Self::Not(condition) => condition.names(),
            Self::And(left, right) | Self::Or(left, right) => [left.names(), right.names()].concat(),
        }
    }
}

impl ComparisonOperator {
    fn holds(self, a: f64, b: f64) -> bool {
        match self {
            Self::Equal => a == b,
            Self::Different => a != b,
            Self::Below => a < b,
            Self::AtMost => a <= b,
            Self::Above => a > b,
            Self::AtLeast => a >= b,
        }
    }

    fn symbol(self) -> &'static str {
        match self {
            Self::Equal => "=",
            Self::Different => "!=",
            Self::Below => "<",
            Self::AtMost => "<=",
            Self::Above => ">",
            Self::AtLeast => ">=",
        }
    }
}

impl StructureProperties<'_> {
    fn number(&self, field: NumberField) -> Option<f64> {
        let atoms = (!self.species.is_empty()).then_some(self.species.len() as f64);
        match field {
            NumberField::Gamma => self.gamma,
            NumberField::GammaCurrent => self.gamma_current,
            NumberField::GammaNbr => self.gamma_nbr,
            NumberField::RelativeVolume => self.relative_volume,
            NumberField::Temperature => self.conditions.map(|conditions| conditions.temperature),
            NumberField::KineticTemperature => self.kinetic_temperature,
            NumberField::Tau => self.conditions.map(|conditions| conditions.tau),
            NumberField::Version => self.conditions.map(|conditions| f64::from(conditions.version)),
            NumberField::Walk => self.walk.map(f64::from),
            NumberField::Step => self.step.map(|step| step as f64),
            NumberField::MixtureVersion => self.mixture_version.map(|version| version as f64),
            NumberField::Atoms => atoms,
            NumberField::Energy => self.energy,
            NumberField::EnergyPerAtom => self.energy.zip(atoms).map(|(energy, atoms)| energy / atoms),
            NumberField::MaxForce => self.max_force,
            NumberField::Fragments => self.fragments.map(|number| number as f64),
        }
    }

    /// Whether the text equals `value`. An element matches if any atom has it, a retry adjustment if it is one of them.
    fn is_text(&self, field: TextField, value: &str) -> Option<bool> {
        match field {
            TextField::Element if self.species.is_empty() => None,
            TextField::Element => Some(self.species.iter().any(|species| species.symbol() == value)),
            TextField::Origin => Some(self.origin == value),
            TextField::Group => self.conditions.map(|conditions| conditions.group == value),
            TextField::SeedStructure => self.seed_structure.map(|name| name == value),
            TextField::RetryAdjustment => {
                self.retry_adjustments.map(|names| names.iter().any(|name| name == value))
            }
        }
    }
}

/// The species of each atom of a formula such as `Al31Mo`.
pub fn species(formula: &str) -> Vec<Species> {
    let mut species = Vec::new();
    let mut rest = formula;
    while !rest.is_empty() {
        let of_symbol = |(place, c): &(usize, char)| *place == 0 || c.is_ascii_lowercase();
        let symbol = rest.char_indices().take_while(of_symbol).map(|(place, c)| place + c.len_utf8()).last();
        let (symbol, after) = rest.split_at(symbol.unwrap_or(rest.len()));
        let digits = after.find(|c: char| !c.is_ascii_digit()).unwrap_or(after.len());
        let (number, after) = after.split_at(digits);
        if let Ok(found) = symbol.parse::<Species>() {
            species.extend(std::iter::repeat_n(found, number.parse().unwrap_or(1)));
        }
        rest = after;
    }
    species
}

impl FromStr for StructureFilter {
    type Err = FilterError;

    fn from_str(text: &str) -> Result<Self, FilterError> {
        parse::parse(text)
    }
}

/// Writes the expression so that it can be parsed again.
impl fmt::Display for StructureFilter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(field, comparison, value) => {
                write!(f, "{} {} {value:?}", field.name(), comparison.symbol())
            }
            Self::Text(field, wanted, value) => {
                let quote = if value.contains('\'') { '"' } else { '\'' };
                let sign = if *wanted { "=" } else { "!=" };
                write!(f, "{} {sign} {quote}{value}{quote}", field.name())
            }
            Self::Not(condition) => write!(f, "not ({condition})"),
            Self::And(left, right) => write!(f, "({left}) and ({right})"),
            Self::Or(left, right) => write!(f, "({left}) or ({right})"),
        }
    }
}
