//! Conditions on structures, as `gamma > 2 and element = Mo`: a small language, described in docs/export.md.

mod parse;
#[cfg(test)]
mod tests;

use std::fmt;
use std::str::FromStr;

use atoms::Species;

pub use parse::FilterError;

/// What is known of a structure that a condition is put to. What is not there meets no comparison.
#[derive(Clone, Debug, Default)]
pub struct StructureProperties<'a> {
    /// Largest γ under the original mixture.
    pub gamma: Option<f64>,
    /// Largest γ_nbr under the original mixture.
    pub gamma_nbr: Option<f64>,
    /// V/V₀.
    pub volume: Option<f64>,
    /// Kinetic temperature, K.
    pub temperature: Option<f64>,
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
    /// The elements of its atoms, an entry an atom; none if they are not known.
    pub species: &'a [Species],
    /// `biased`, `control` or `imported`.
    pub kind: &'a str,
    /// Name of the seed structure.
    pub seed: Option<&'a str>,
}

/// A condition.
#[derive(Clone, Debug, PartialEq)]
pub enum Filter {
    /// A number beside another.
    NumberField(NumberField, Comparison, f64),
    /// A text that is, or is not, another.
    TextField(TextField, bool, String),
    /// Not that.
    Not(Box<Filter>),
    /// Both.
    And(Box<Filter>, Box<Filter>),
    /// One or both.
    Or(Box<Filter>, Box<Filter>),
}

/// How numbers are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Comparison {
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
            /// Each with its name.
            pub const ALL: &[(Self, &str)] = &[$((Self::$variant, $name)),*];

            fn name(self) -> &'static str {
                match self { $(Self::$variant => $name),* }
            }
        }
    };
}

names! {
    /// What is a number.
    NumberField {
        Gamma "gamma", GammaNbr "gamma_nbr", Volume "volume", Temperature "temperature", Walk "walk", Step "step",
        MixtureVersion "mixture_version", Atoms "atoms", Energy "energy", EnergyPerAtom "energy_per_atom",
        MaxForce "max_force"
    }
}

names! {
    /// What is a text.
    TextField { Element "element", Kind "kind", Seed "seed" }
}

impl Filter {
    /// Whether a structure meets it.
    pub fn matches(&self, facts: &StructureProperties<'_>) -> bool {
        match self {
            Self::NumberField(column, comparison, value) => {
                facts.number(*column).is_some_and(|number| comparison.holds(number, *value))
            }
            Self::TextField(column, wanted, value) => {
                facts.is_text(*column, value).is_some_and(|found| found == *wanted)
            }
            Self::Not(condition) => !condition.matches(facts),
            Self::And(left, right) => left.matches(facts) && right.matches(facts),
            Self::Or(left, right) => left.matches(facts) || right.matches(facts),
        }
    }
}

impl Filter {
    /// The names that stand in it, as they are written.
    pub fn names(&self) -> Vec<&'static str> {
        match self {
            Self::NumberField(column, ..) => vec![column.name()],
            Self::TextField(column, ..) => vec![column.name()],
            Self::Not(condition) => condition.names(),
            Self::And(left, right) | Self::Or(left, right) => [left.names(), right.names()].concat(),
        }
    }
}

impl Comparison {
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

    fn sign(self) -> &'static str {
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
    fn number(&self, column: NumberField) -> Option<f64> {
        let atoms = (!self.species.is_empty()).then_some(self.species.len() as f64);
        match column {
            NumberField::Gamma => self.gamma,
            NumberField::GammaNbr => self.gamma_nbr,
            NumberField::Volume => self.volume,
            NumberField::Temperature => self.temperature,
            NumberField::Walk => self.walk.map(f64::from),
            NumberField::Step => self.step.map(|step| step as f64),
            NumberField::MixtureVersion => self.mixture_version.map(|version| version as f64),
            NumberField::Atoms => atoms,
            NumberField::Energy => self.energy,
            NumberField::EnergyPerAtom => self.energy.zip(atoms).map(|(energy, atoms)| energy / atoms),
            NumberField::MaxForce => self.max_force,
        }
    }

    /// Whether the text is this one; of elements, whether one of the atoms is it.
    fn is_text(&self, column: TextField, value: &str) -> Option<bool> {
        match column {
            TextField::Element if self.species.is_empty() => None,
            TextField::Element => Some(self.species.iter().any(|species| species.symbol() == value)),
            TextField::Kind => Some(self.kind == value),
            TextField::Seed => self.seed.map(|seed| seed == value),
        }
    }
}

/// The atoms of a formula as `Al31Mo`, an entry an atom.
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

impl FromStr for Filter {
    type Err = FilterError;

    fn from_str(text: &str) -> Result<Self, FilterError> {
        parse::parse(text)
    }
}

/// As it can be read again.
impl fmt::Display for Filter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NumberField(column, comparison, value) => {
                write!(f, "{} {} {value:?}", column.name(), comparison.sign())
            }
            Self::TextField(column, wanted, value) => {
                let quote = if value.contains('\'') { '"' } else { '\'' };
                let sign = if *wanted { "=" } else { "!=" };
                write!(f, "{} {sign} {quote}{value}{quote}", column.name())
            }
            Self::Not(condition) => write!(f, "not ({condition})"),
            Self::And(left, right) => write!(f, "({left}) and ({right})"),
            Self::Or(left, right) => write!(f, "({left}) or ({right})"),
        }
    }
}
