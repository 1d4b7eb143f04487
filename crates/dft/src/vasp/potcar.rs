//! POTCAR files of the user.

use std::path::{Path, PathBuf};

use atoms::Species;

use super::output;
use crate::SetupError;

/// First word of the title: the PBE sets for the projector augmented-wave method.
const SET: &str = "PAW_PBE";

/// The POTCAR of one element.
#[derive(Clone, Debug)]
pub(super) struct Potcar {
    /// `PAW_PBE Al_pv 06Sep2000`
    pub title: String,
    /// Number of valence electrons.
    pub valence: f64,
    /// BLAKE3 of the file.
    pub hash: String,
    /// The file, ending with a line break.
    pub content: Vec<u8>,
}

impl Potcar {
    /// Finds `variant` of `species` under `directory`, as `<variant>/POTCAR`, `POTCAR.<variant>` or
    /// `<variant>`, and checks that the content matches the name.
    ///
    /// # Errors
    /// [`SetupError::Pseudopotential`]
    pub fn find(directory: &Path, species: Species, variant: &str) -> Result<Self, SetupError> {
        let wrong = |reason: String| SetupError::Pseudopotential { species, reason };
        let candidates = [
            directory.join(variant).join("POTCAR"),
            directory.join(format!("POTCAR.{variant}")),
            directory.join(variant),
        ];
        let Some(path) = candidates.iter().find(|path| path.is_file()) else {
            return Err(wrong(missing(directory, &candidates, species)));
        };
        let content = std::fs::read(path).map_err(|error| wrong(format!("{}: {error}", path.display())))?;
        Self::new(content, species, variant).map_err(|reason| wrong(format!("{}: {reason}", path.display())))
    }

    fn new(mut content: Vec<u8>, species: Species, variant: &str) -> Result<Self, String> {
        let hash = blake3::hash(&content).to_hex().to_string();
        let text = String::from_utf8_lossy(&content);
        let sets = text.lines().filter(|line| line.trim() == "End of Dataset").count();
        if sets != 1 {
            return Err(format!("has {sets} lines 'End of Dataset', expected one: a POTCAR of one element"));
        }
        let title = after(&text, "TITEL").ok_or("has no line TITEL")?.trim().to_owned();
        let words: Vec<&str> = title.split_whitespace().collect();
        if words.first() != Some(&SET) || words.get(1) != Some(&variant) {
            return Err(format!("its TITEL is '{title}', expected '{SET} {variant} …'"));
        }
        let element = after(&text, "VRHFIN").and_then(|rest| rest.split(|c: char| !c.is_alphabetic()).next());
        if element.and_then(output::element) != Some(species) {
            let found = element.unwrap_or("missing");
            return Err(format!("its element (VRHFIN) is {found}, expected {species}"));
        }
        let valence = after(&text, "ZVAL").and_then(|rest| rest.split_whitespace().next()?.parse().ok());
        let valence =
            valence.filter(|z: &f64| z.is_finite() && *z > 0.0).ok_or("has no number of electrons (ZVAL)")?;
        if content.last() != Some(&b'\n') {
            content.push(b'\n');
        }
        Ok(Self { title, valence, hash, content })
    }
}

/// The text after `name =` in the first line that has it.
fn after<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    text.lines().find_map(|line| Some(line.split_once(name)?.1.trim_start().strip_prefix('=')?.trim_start()))
}

/// Lists the paths that were tried and what exists for this element.
fn missing(directory: &Path, candidates: &[PathBuf], species: Species) -> String {
    let sought: Vec<String> = candidates.iter().map(|path| path.display().to_string()).collect();
    let of_element = |name: &String| {
        let rest = name.strip_prefix("POTCAR.").unwrap_or(name).strip_prefix(species.symbol());
        rest.is_some_and(|rest| !rest.starts_with(|c: char| c.is_ascii_lowercase()))
    };
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let mut there: Vec<String> =
        entries.filter_map(|entry| entry.file_name().into_string().ok()).filter(of_element).collect();
    there.sort();
    let there = match there.is_empty() {
        true => format!("{} has no POTCAR of {species}", directory.display()),
        false => format!(
            "{} has {}; choose one in `pseudopotential_variants`",
            directory.display(),
            there.join(", ")
        ),
    };
    format!("none of {} exists; {there}", sought.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALUMINIUM: &str = "  PAW_PBE Al_pv 01Jan2000\n   VRHFIN =Al: p6 s2p1\n   TITEL  = PAW_PBE Al_pv 01Jan2000\n   \
                             POMASS =   26.982; ZVAL   =    9.000    mass and valenz\n End of Dataset\n";

    fn aluminium() -> Species {
        "Al".parse().unwrap()
    }

    #[test]
    fn all_layouts_are_found() {
        let directory = tempfile::tempdir().unwrap();
        for name in ["Al_pv/POTCAR", "POTCAR.Al_pv", "Al_pv"] {
            let path = directory.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, ALUMINIUM).unwrap();
            let potcar = Potcar::find(directory.path(), aluminium(), "Al_pv").unwrap();
            assert_eq!((potcar.title.as_str(), potcar.valence), ("PAW_PBE Al_pv 01Jan2000", 9.0));
            assert_eq!(potcar.hash, blake3::hash(ALUMINIUM.as_bytes()).to_hex().to_string());
            let first = directory.path().join(name.split('/').next().unwrap());
            if first.is_dir() {
                std::fs::remove_dir_all(first).unwrap()
            } else {
                std::fs::remove_file(first).unwrap()
            }
        }
    }

    #[test]
    fn what_is_missing_is_told_with_what_there_is() {
        let directory = tempfile::tempdir().unwrap();
        for name in ["Al_pv", "Al_GW", "Ag", "A"] {
            std::fs::create_dir(directory.path().join(name)).unwrap();
        }
        let message = Potcar::find(directory.path(), aluminium(), "Al").unwrap_err().to_string();
        assert!(message.contains("/Al/POTCAR"), "{message}");
        assert!(message.ends_with("has Al_GW, Al_pv; choose one in `pseudopotential_variants`"), "{message}");
        let nowhere = Potcar::find(Path::new("/no/such/place"), aluminium(), "Al").unwrap_err().to_string();
        assert!(nowhere.ends_with("/no/such/place has no POTCAR of Al"), "{nowhere}");
    }

    #[test]
    fn a_file_that_is_not_what_its_name_says_is_refused() {
        let fault = |from: &str, to: &str| {
            let content = ALUMINIUM.replace(from, to).into_bytes();
            Potcar::new(content, aluminium(), "Al_pv").unwrap_err()
        };
        assert!(
            fault("PAW_PBE Al_pv", "PAW_PBE Al")
                .contains("'PAW_PBE Al 01Jan2000', expected 'PAW_PBE Al_pv …'")
        );
        assert!(fault("PAW_PBE", "PAW").contains("expected 'PAW_PBE Al_pv …'"));
        assert!(fault("=Al:", "=Si:").contains("is Si, expected Al"));
        assert!(fault("ZVAL", "ZV").contains("ZVAL"));
        assert!(fault("9.000", "nine").contains("ZVAL"));
        assert!(fault("End of", "end of").contains("has 0 lines"));
        let two = Potcar::new(ALUMINIUM.repeat(2).into_bytes(), aluminium(), "Al_pv").unwrap_err();
        assert!(two.contains("has 2 lines"));
    }
}
