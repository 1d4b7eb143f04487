//! Whether two servers have the same model: after a restart, on another device, or on another host.

use serde::{Deserialize, Serialize};

use crate::description::{ModelDescription, RawFeatures};

/// Largest relative difference of the test structure's energies.
const TOLERANCE: f64 = 1e-5;

/// What all servers of a campaign have in common.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelReference {
    /// What a server says of its model.
    pub description: ModelDescription,
    /// The energy of each atom of the test structure, eV.
    pub energies: Vec<f64>,
}

impl ModelReference {
    /// Checks that another server's model is this one; with `same_bits`, that its energies have the same bits.
    ///
    /// # Errors
    /// What differs: what was found and what was expected.
    pub fn check(&self, found: &Self, same_bits: bool) -> Result<(), String> {
        self.description.check_same(&found.description)?;
        if !have_same_energies(&found.energies, &self.energies) {
            let [energy, expected] = [found, self].map(|one| one.energies.iter().sum::<f64>());
            return Err(format!("energy of the test structure {energy} eV, expected {expected} eV"));
        }
        if same_bits && found.energies != self.energies {
            return Err(format!(
                "the energy of the test structure has other bits on {} than on {}: a reproducible campaign needs one kind of device and \
                 the same versions everywhere",
                found.description.device_and_versions(),
                self.description.device_and_versions()
            ));
        }
        Ok(())
    }
}

impl ModelDescription {
    /// Checks that another server says the same of its model.
    ///
    /// # Errors
    /// What differs: what was found and what was expected.
    pub(crate) fn check_same(&self, found: &Self) -> Result<(), String> {
        let differences = self.differences(found);
        if differences.is_empty() { Ok(()) } else { Err(differences.join("; ")) }
    }

    /// What of another server's model is not as here: what was found and what was expected.
    fn differences(&self, found: &Self) -> Vec<String> {
        let facts = |one: &Self| {
            let RawFeatures { form, blocks, .. } = &one.features;
            [
                ("hash", one.identity.clone()),
                ("elements", one.elements.join(" ")),
                ("cutoffs", format!("{:?} Å", one.cutoffs)),
                ("features", format!("{form:?} in blocks of {blocks:?}")),
                ("precision", one.precision.clone()),
            ]
        };
        let pairs = facts(found).into_iter().zip(facts(self));
        let different = pairs.filter(|(found, expected)| found != expected);
        different
            .map(|((what, found), (_, expected))| format!("{what} {found}, expected {expected}"))
            .collect()
    }

    /// For instance `cuda:0 with python 3.11.7, torch 2.6.0`.
    pub(crate) fn device_and_versions(&self) -> String {
        let versions: Vec<_> =
            self.versions.iter().map(|(name, version)| format!("{name} {version}")).collect();
        format!("{} with {}", self.device, versions.join(", "))
    }
}

/// Whether energies are those expected, apart from rounding.
pub(crate) fn have_same_energies(found: &[f64], expected: &[f64]) -> bool {
    let size = expected.iter().map(|x| x.abs()).fold(1.0, f64::max);
    found.len() == expected.len()
        && found.iter().zip(expected).all(|(a, b)| (a - b).abs() <= TOLERANCE * size)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::description::{AdapterFeatures, PROTOCOL};

    pub(crate) fn reference() -> ModelReference {
        let description = ModelDescription {
            protocol: PROTOCOL,
            adapter: "mace".to_owned(),
            versions: [("torch".to_owned(), "2.6".to_owned())].into(),
            device: "cuda:0".to_owned(),
            elements: vec!["Al".to_owned()],
            cutoffs: vec![vec![6.0]],
            features: RawFeatures { form: AdapterFeatures::Raw, dimension: 8, blocks: vec![8] },
            precision: "double".to_owned(),
            padding: false,
            evaluates_without_forces: false,
            identity: "aa".to_owned(),
            max_structures: None,
        };
        ModelReference { description, energies: vec![-3.0, -2.0] }
    }

    #[test]
    fn another_device_may_have_the_same_model() {
        let mut other = reference();
        other.description.device = "cuda:1".to_owned();
        other.description.max_structures = Some(4);
        assert_eq!(reference().check(&other, true), Ok(()));
        other.energies[0] += 1e-12;
        assert_eq!(reference().check(&other, false), Ok(()));
        let error = reference().check(&other, true).unwrap_err();
        assert!(error.contains("other bits on cuda:1 with torch 2.6 than on cuda:0"), "{error}");
    }

    #[test]
    fn everything_that_differs_is_named() {
        let mut other = reference();
        other.description.identity = "bb".to_owned();
        other.description.cutoffs = vec![vec![5.0]];
        other.description.precision = "single".to_owned();
        let error = reference().check(&other, false).unwrap_err();
        assert_eq!(
            error,
            "hash bb, expected aa; cutoffs [[5.0]] Å, expected [[6.0]] Å; precision single, expected double"
        );
        let mut other = reference();
        other.energies[1] = -2.1;
        let error = reference().check(&other, false).unwrap_err();
        assert_eq!(error, "energy of the test structure -5.1 eV, expected -5 eV");
    }
}
