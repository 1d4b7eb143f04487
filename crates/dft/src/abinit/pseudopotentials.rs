//! Pseudopotentials of ABINIT: `Si.psp8` (norm-conserving) or `Si.xml` (PAW) in one directory.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use atoms::Species;

use crate::{PinnedFile, SetupError, paw};

/// A pseudopotential.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Pseudopotential {
    /// Its file.
    pub pinned: PinnedFile,
    /// Number of valence electrons.
    pub valence: f64,
    /// Whether it is a PAW setup.
    pub paw: bool,
}

impl Pseudopotential {
    /// File name of the copy for a calculation: ABINIT depends on the extension.
    pub fn copy(&self, species: Species) -> String {
        format!("{species}.{}", if self.paw { "xml" } else { "psp8" })
    }
}

/// All pseudopotentials in the directory.
pub(super) fn find(
    directory: &Path,
    pseudopotential_variants: &BTreeMap<Species, String>,
) -> Result<BTreeMap<Species, Pseudopotential>, SetupError> {
    let mut found = BTreeMap::new();
    for species in (1..=118).filter_map(|number| Species::from_atomic_number(number).ok()) {
        let names = match pseudopotential_variants.get(&species) {
            Some(name) => vec![name.clone()],
            None => vec![format!("{species}.psp8"), format!("{species}.xml")],
        };
        let Some(file) = names.into_iter().find(|name| directory.join(name).is_file()) else {
            if pseudopotential_variants.contains_key(&species) {
                return Err(missing(species, directory, pseudopotential_variants));
            }
            continue;
        };
        found.insert(species, read(species, directory.join(file))?);
    }
    Ok(found)
}

/// The error for an element without a pseudopotential.
pub(super) fn missing(
    species: Species,
    directory: &Path,
    pseudopotential_variants: &BTreeMap<Species, String>,
) -> SetupError {
    let usual = || format!("{species}.psp8 or {species}.xml");
    let sought = pseudopotential_variants.get(&species).cloned().unwrap_or_else(usual);
    SetupError::missing_pseudopotential(species, &sought, directory)
}

fn read(species: Species, path: PathBuf) -> Result<Pseudopotential, SetupError> {
    let shown = path.display().to_string();
    let wrong =
        |reason: String| SetupError::Pseudopotential { species, reason: format!("{shown}: {reason}") };
    let paw = path.extension().is_some_and(|extension| extension == "xml");
    let (pinned, content) = PinnedFile::open(path).map_err(|error| wrong(error.to_string()))?;
    let valence = match paw {
        true => paw::valence(&content, species),
        false => valence(&content, species),
    };
    Ok(Pseudopotential { pinned, valence: valence.map_err(wrong)?, paw })
}

/// Valence electrons of a `psp8` file: Z and the valence start its second line, format and functional its
/// third.
fn valence(file: &[u8], species: Species) -> Result<f64, String> {
    // 11 is ABINIT's own PBE, the other is libxc's.
    const PBE: [&str; 2] = ["11", "-101130"];
    let head = String::from_utf8_lossy(&file[..file.len().min(4096)]);
    let mut lines = head.lines().skip(1).map(str::split_whitespace);
    let mut word = || Some((lines.next()?, lines.next()?));
    let (mut second, mut third) = word().ok_or("has no header")?;
    let mut number = || second.next().and_then(|word| word.parse::<f64>().ok());
    let (charge, valence) = (number(), number());
    if third.next() != Some("8") || charge != Some(f64::from(species.atomic_number())) {
        return Err(format!("is not a psp8 file of {species}"));
    }
    match (third.next(), valence) {
        (Some(functional), Some(valence)) if PBE.contains(&functional) && valence >= 0.0 => Ok(valence),
        (functional, _) => {
            Err(format!("is for the functional {}, not for PBE (11)", functional.unwrap_or("?")))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SILICON: &str = "Si    ONCVPSP-3.2.3.1\n14.0000      4.0000      170510    zatom,zion,pspd\n\
                           8      11   2     4   600     0    pspcod,pspxc\n";

    #[test]
    fn the_head_says_what_a_file_is() {
        let silicon = "Si".parse().unwrap();
        assert_eq!(valence(SILICON.as_bytes(), silicon), Ok(4.0));
        assert_eq!(
            valence(SILICON.as_bytes(), "Al".parse().unwrap()),
            Err("is not a psp8 file of Al".into())
        );
        let lda = SILICON.replace("   11   2", "   -1012   2").replace("      11   2", "      -1012   2");
        assert_eq!(
            valence(lda.as_bytes(), silicon),
            Err("is for the functional -1012, not for PBE (11)".into())
        );
        for end in 0..SILICON.find(" 11").unwrap() + 2 {
            assert!(valence(&SILICON.as_bytes()[..end], silicon).is_err(), "cut at {end}");
        }
    }

    #[test]
    fn a_missing_one_names_element_and_directory() {
        let directory = tempfile::tempdir().unwrap();
        std::fs::write(directory.path().join("Si.psp8"), SILICON).unwrap();
        let found = find(directory.path(), &BTreeMap::new()).unwrap();
        assert_eq!(found.len(), 1);
        let pseudopotential_variants = BTreeMap::from([("Zn".parse().unwrap(), "Zn-sp.psp8".to_owned())]);
        let error = find(directory.path(), &pseudopotential_variants).unwrap_err().to_string();
        let expected = format!("pseudopotential of Zn: no Zn-sp.psp8 in {}", directory.path().display());
        assert!(error.starts_with(&expected), "{error}");
    }
}
