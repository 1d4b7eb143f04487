//! PAW setups, found as GPAW does: `Si.PBE` or `Si.PBE.gz` in the first directory that has one.

use std::collections::BTreeMap;
use std::path::PathBuf;

use atoms::Species;

use crate::{PinnedFile, SetupError, paw};

/// A setup.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Setup {
    /// Its file.
    pub pinned: PinnedFile,
    /// Number of valence electrons.
    pub valence: f64,
}

/// All available setups.
pub(super) fn find(
    directories: &[PathBuf],
    pseudopotential_variants: &BTreeMap<Species, String>,
) -> Result<BTreeMap<Species, Setup>, SetupError> {
    let mut setups = BTreeMap::new();
    for species in (1..=118).filter_map(|number| Species::from_atomic_number(number).ok()) {
        let name = name(species, pseudopotential_variants);
        // Of the candidates in a directory GPAW takes the last by name.
        let candidates = |directory: &PathBuf| [directory.join(format!("{name}.gz")), directory.join(&name)];
        let Some(path) = directories.iter().flat_map(candidates).find(|path| path.is_file()) else {
            if pseudopotential_variants.contains_key(&species) {
                return Err(missing(species, directories, pseudopotential_variants));
            }
            continue;
        };
        let shown = path.display().to_string();
        let setup = read(species, path).map_err(|reason| SetupError::Pseudopotential {
            species,
            reason: format!("{shown}: {reason}"),
        })?;
        setups.insert(species, setup);
    }
    Ok(setups)
}

/// The error for an element without a setup.
pub(super) fn missing(
    species: Species,
    directories: &[PathBuf],
    pseudopotential_variants: &BTreeMap<Species, String>,
) -> SetupError {
    let looked: Vec<String> = directories.iter().map(|path| path.display().to_string()).collect();
    let reason = format!(
        "no setup {} (or .gz) in {}: install GPAW's setups, or name their directory in `pseudopotentials`",
        name(species, pseudopotential_variants),
        looked.join(", ")
    );
    SetupError::Pseudopotential { species, reason }
}

/// `Si.PBE`, or with a variant `Ni.10.PBE`.
pub(super) fn name(species: Species, pseudopotential_variants: &BTreeMap<Species, String>) -> String {
    match pseudopotential_variants.get(&species) {
        Some(variant) => format!("{species}.{variant}.PBE"),
        None => format!("{species}.PBE"),
    }
}

fn read(species: Species, path: PathBuf) -> Result<Setup, String> {
    let (pinned, content) = PinnedFile::open(path).map_err(|error| format!("cannot be read: {error}"))?;
    Ok(Setup { pinned, valence: paw::valence(&content, species)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "<?xml version=\"1.0\"?>\n<paw_setup version=\"0.6\">\n  \
                        <atom symbol=\"Si\" Z=\"14\" core=\"10.0\" valence=\"4\"/>\n  \
                        <xc_functional type=\"GGA\" name=\"PBE\"/>\n";

    fn species(symbol: &str) -> Species {
        symbol.parse().unwrap()
    }

    #[test]
    fn a_setup_is_found_where_gpaw_finds_it_and_must_be_of_its_element() {
        let directories = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let paths = directories.each_ref().map(|directory| directory.path().to_owned());
        std::fs::write(paths[1].join("Si.PBE"), HEAD).unwrap();
        let none = BTreeMap::new();
        let setups = find(&paths, &none).unwrap();
        assert_eq!(setups.keys().copied().collect::<Vec<_>>(), [species("Si")]);
        assert_eq!(setups[&species("Si")].valence, 4.0);

        std::fs::write(paths[0].join("Si.PBE"), HEAD.replace("valence=\"4\"", "valence=\"12\"")).unwrap();
        let first = find(&paths, &none).unwrap();
        assert_eq!(first[&species("Si")].valence, 12.0);
        assert_ne!(first[&species("Si")].pinned.hash(), setups[&species("Si")].pinned.hash());

        std::fs::write(paths[0].join("Al.PBE"), HEAD).unwrap();
        let error = find(&paths, &none).unwrap_err().to_string();
        assert!(error.contains("is not a PAW setup of Al"), "{error}");
    }

    #[test]
    fn a_missing_variant_names_element_and_directories() {
        let directory = tempfile::tempdir().unwrap();
        let paths = [directory.path().to_owned()];
        let error =
            find(&paths, &BTreeMap::from([(species("Ni"), "10".to_owned())])).unwrap_err().to_string();
        assert!(error.starts_with("pseudopotential of Ni: no setup Ni.10.PBE (or .gz) in "), "{error}");
        assert!(error.contains(&paths[0].display().to_string()), "{error}");
    }
}
