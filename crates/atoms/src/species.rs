//! The chemical element of an atom.

use std::fmt;
use std::str::FromStr;

use mendeleev::Element;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A chemical element, by atomic number (1 … 118).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(extend("pattern" = "^[A-Z][a-z]?$"))]
pub struct Species(u8);

/// A symbol or atomic number of no element.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown element '{0}' (expected a symbol such as Al, or an atomic number from 1 to 118)")]
pub struct UnknownSpecies(pub String);

impl Species {
    /// The element of atomic number `number`.
    pub fn from_atomic_number(number: u8) -> Result<Self, UnknownSpecies> {
        if (1..=118).contains(&number) { Ok(Self(number)) } else { Err(UnknownSpecies(number.to_string())) }
    }

    /// Atomic number Z.
    pub fn atomic_number(self) -> u8 {
        self.0
    }

    /// Symbol, `"Al"`.
    pub fn symbol(self) -> &'static str {
        self.element().symbol()
    }

    /// Standard atomic weight, u; the mass number of the most stable isotope where there is none.
    pub fn mass(self) -> f64 {
        self.element().atomic_weight().into()
    }

    /// Empirical radius (Slater), Å: bonded neighbours are about the sum of their radii apart. `None` for noble
    /// gases, which form no bonds, and where unknown.
    pub fn radius(self) -> Option<f64> {
        const NOBLE: [u8; 7] = [2, 10, 18, 36, 54, 86, 118];
        let radius = self.element().atomic_radius().filter(|_| !NOBLE.contains(&self.0))?;
        Some(radius.0 / 100.0)
    }

    fn element(self) -> Element {
        // The constructor admits only 1 … 118, the range of the table.
        mendeleev::ALL_ELEMENTS[usize::from(self.0) - 1]
    }
}

/// Atomic number and number of atoms of each element, by ascending atomic number.
pub fn composition(species: &[Species]) -> Vec<(u8, u32)> {
    let mut numbers: Vec<_> = species.iter().map(|species| species.atomic_number()).collect();
    numbers.sort_unstable();
    numbers.chunk_by(|a, b| a == b).map(|run| (run[0], run.len() as u32)).collect()
}

/// Symbol of an atomic number; `"?"` where there is no element.
pub fn element_symbol(atomic_number: u8) -> &'static str {
    Species::from_atomic_number(atomic_number).map_or("?", Species::symbol)
}

impl FromStr for Species {
    type Err = UnknownSpecies;

    fn from_str(symbol: &str) -> Result<Self, UnknownSpecies> {
        mendeleev::ALL_ELEMENTS
            .iter()
            .position(|element| element.symbol() == symbol)
            .map(|index| Self(index as u8 + 1))
            // The text may be a whole line of an invalid file.
            .ok_or_else(|| UnknownSpecies(symbol.chars().take(60).collect()))
    }
}

impl TryFrom<String> for Species {
    type Error = UnknownSpecies;

    fn try_from(symbol: String) -> Result<Self, UnknownSpecies> {
        symbol.parse()
    }
}

impl From<Species> for String {
    fn from(species: Species) -> Self {
        species.symbol().to_owned()
    }
}

impl fmt::Display for Species {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.symbol())
    }
}

impl fmt::Debug for Species {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.symbol())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn radii_are_those_of_bonds() {
        let radius = |symbol: &str| symbol.parse::<Species>().unwrap().radius();
        assert_eq!((radius("Al"), radius("Si"), radius("H")), (Some(1.25), Some(1.1), Some(0.25)));
        assert_eq!((radius("He"), radius("Ar"), radius("Cm")), (None, None, None));
    }

    #[test]
    fn every_element_goes_to_its_symbol_and_back() {
        for number in 1..=118 {
            let species = Species::from_atomic_number(number).unwrap();
            assert_eq!(species.symbol().parse(), Ok(species));
            assert!(species.mass() >= 1.0);
        }
        assert_eq!("Al".parse::<Species>().unwrap().atomic_number(), 13);
        assert!("al".parse::<Species>().is_err());
        assert!(Species::from_atomic_number(0).is_err());
    }

    #[test]
    fn atoms_are_counted_by_atomic_number() {
        let species = ["Ni", "H", "Ni", "Al"].map(|symbol| symbol.parse().unwrap());
        assert_eq!(composition(&species), [(1, 1), (13, 1), (28, 2)]);
        assert!(composition(&[]).is_empty());
        assert_eq!([28, 118, 0, 119].map(element_symbol), ["Ni", "Og", "?", "?"]);
    }

    #[test]
    fn masses_are_the_standard_atomic_weights() {
        for (symbol, mass) in [("H", 1.008), ("Al", 26.9815), ("Si", 28.085), ("W", 183.84)] {
            let species: Species = symbol.parse().unwrap();
            assert!((species.mass() - mass).abs() < 1e-3, "{symbol} {}", species.mass());
        }
    }
}
