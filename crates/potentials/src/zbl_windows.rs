//! Between which distances the ZBL repulsion of each pair of elements is switched off.

use std::collections::BTreeMap;

use atoms::{ElementPair, Species};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the windows of the repulsion are chosen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "rule", rename_all = "snake_case")]
pub enum ZblWindows {
    /// For each pair of elements, by their covalent radii.
    PerPair(RadiiWindows),
    /// One window for all pairs.
    Uniform(ZblWindow),
}

/// Windows as fractions of the sum of covalent radii.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RadiiWindows {
    /// Fraction below which the repulsion has its full strength.
    pub inner: f64,
    /// Fraction above which the repulsion is zero.
    pub outer: f64,
    /// Windows of single pairs, Å, instead of these fractions.
    #[schemars(
        with = "BTreeMap<String, ZblWindow>",
        extend(
            "additionalProperties" = false,
            "patternProperties" = { "^[A-Z][a-z]?-[A-Z][a-z]?$": {
                "type": "object", "additionalProperties": false, "required": ["inner", "outer"],
                "properties": { "inner": { "type": "number" }, "outer": { "type": "number" } },
            } },
        )
    )]
    pub pairs: BTreeMap<ElementPair, ZblWindow>,
}

/// A window.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ZblWindow {
    /// Distance below which the repulsion has its full strength, Å.
    pub inner: f64,
    /// Distance above which the repulsion is zero, Å.
    pub outer: f64,
}

impl Default for RadiiWindows {
    fn default() -> Self {
        Self { inner: 0.55, outer: 0.75, pairs: BTreeMap::new() }
    }
}

impl ZblWindows {
    /// The window of a pair of elements.
    pub fn window(&self, pair: ElementPair) -> ZblWindow {
        match self {
            Self::Uniform(window) => *window,
            Self::PerPair(RadiiWindows { inner, outer, pairs }) => {
                let radii = pair.covalent_radii();
                let window = ZblWindow { inner: inner * radii, outer: outer * radii };
                pairs.get(&pair).copied().unwrap_or(window)
            }
        }
    }

    /// The pair of these elements with the window that ends farthest out.
    pub fn widest(&self, species: &[Species]) -> Option<(ElementPair, ZblWindow)> {
        let pairs = species.iter().flat_map(|a| species.iter().map(|b| ElementPair::new(*a, *b)));
        pairs.map(|pair| (pair, self.window(pair))).max_by(|a, b| a.1.outer.total_cmp(&b.1.outer))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_follow_the_covalent_radii() {
        let windows: ZblWindows = serde_json::from_str(
            r#"{ "rule": "per_pair", "pairs": { "O-H": { "inner": 0.4, "outer": 0.6 } } }"#,
        )
        .unwrap();
        let window = |pair: &str| windows.window(ElementPair::try_from(pair.to_owned()).unwrap());
        let near = |found: ZblWindow, inner: f64, outer: f64| {
            (found.inner - inner).abs() < 1e-12 && (found.outer - outer).abs() < 1e-12
        };
        assert!(near(window("H-H"), 0.55 * 0.62, 0.75 * 0.62));
        assert!(near(window("Ni-Al"), 0.55 * 2.45, 0.75 * 2.45));
        assert!(near(window("H-O"), 0.4, 0.6));
        let species = ["H", "Al", "Ni"].map(|symbol| symbol.parse().unwrap());
        let (widest, _) = windows.widest(&species).unwrap();
        assert_eq!(widest.to_string(), "Ni-Ni");
    }
}
