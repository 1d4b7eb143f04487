//! GTH pseudopotentials and MOLOPT basis sets from CP2K's data files.

use std::collections::BTreeMap;

use atoms::Species;

use super::Cp2kSettings;
use crate::SetupError;

/// The file of the basis sets.
pub(super) const BASES: &str = "BASIS_MOLOPT";
/// The file of the pseudopotentials.
pub(super) const POTENTIALS: &str = "GTH_POTENTIALS";
/// Prefix of the PBE pseudopotentials.
const FUNCTIONAL: &str = "GTH-PBE";

/// Pseudopotential and basis set of an element.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct AtomicKind {
    /// Name of the pseudopotential.
    pub potential: String,
    /// Number of valence electrons.
    pub valence: f64,
    /// The entries of both.
    pub entries: DataFileEntries,
}

/// Entries of the data files.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct DataFileEntries {
    pub potential: String,
    pub basis: String,
}

impl DataFileEntries {
    /// BLAKE3 of both.
    pub fn hash(&self) -> String {
        blake3::hash(format!("{}\n{}", self.potential, self.basis).as_bytes()).to_hex().to_string()
    }
}

/// All elements that have both.
pub(super) fn find(settings: &Cp2kSettings) -> Result<BTreeMap<Species, AtomicKind>, SetupError> {
    let (potentials, bases) = (text(settings, POTENTIALS)?, text(settings, BASES)?);
    let mut kinds = BTreeMap::new();
    for species in (1..=118).filter_map(|number| Species::from_atomic_number(number).ok()) {
        let wrong = |reason: String| SetupError::Pseudopotential { species, reason };
        match kind(&potentials, &bases, species, settings) {
            Ok(Some(kind)) => drop(kinds.insert(species, kind)),
            Ok(None) if settings.pseudopotential_variants.contains_key(&species) => {
                return Err(missing(species, settings));
            }
            Ok(None) => {}
            Err(reason) => return Err(wrong(reason)),
        }
    }
    Ok(kinds)
}

/// The error for an element that lacks one of them.
pub(super) fn missing(species: Species, settings: &Cp2kSettings) -> SetupError {
    let directory = settings.pseudopotentials.display();
    let reason = format!(
        "no pseudopotential {} in {directory}/{POTENTIALS} with a basis set {} in {directory}/{BASES}: name another \
         directory in `pseudopotentials`, another pseudopotential in `pseudopotential_variants`, or another `basis`",
        potential(species, settings),
        settings.basis
    );
    SetupError::Pseudopotential { species, reason }
}

fn text(settings: &Cp2kSettings, name: &str) -> Result<String, SetupError> {
    let path = settings.pseudopotentials.join(name);
    std::fs::read_to_string(&path).map_err(|error| SetupError::Setting {
        key: "pseudopotentials",
        found: settings.pseudopotentials.display().to_string(),
        expected: format!("CP2K's data directory, with {name} ({error})"),
    })
}

fn potential(species: Species, settings: &Cp2kSettings) -> &str {
    settings.pseudopotential_variants.get(&species).map_or(FUNCTIONAL, String::as_str)
}

fn kind(
    potentials: &str,
    bases: &str,
    species: Species,
    settings: &Cp2kSettings,
) -> Result<Option<AtomicKind>, String> {
    let name = potential(species, settings);
    if name != FUNCTIONAL && !name.starts_with("GTH-PBE-") {
        return Err(format!(
            "{name} in `pseudopotential_variants` is not of PBE: expected {FUNCTIONAL} or {FUNCTIONAL}-q<electrons>"
        ));
    }
    let Some(potential) = entry(potentials, species, |names| names.contains(&name)) else { return Ok(None) };
    let Some(valence) = valence(potential) else {
        return Err(format!("{name} in {POTENTIALS} does not begin with its electrons"));
    };
    // Basis sets are made for a number of electrons, which one of their names may state.
    let charged = format!("{}-q{valence}", settings.basis);
    let fits = |names: &[&str]| {
        names.contains(&charged.as_str())
            || names.contains(&settings.basis.as_str()) && !names.iter().any(|name| name.contains("-q"))
    };
    let Some(basis) = entry(bases, species, fits) else { return Ok(None) };
    let entries = DataFileEntries { potential: potential.to_owned(), basis: basis.to_owned() };
    Ok(Some(AtomicKind { potential: name.to_owned(), valence, entries }))
}

/// The lines of the first entry of this element whose names match. An entry starts with a symbol and ends
/// before the next.
fn entry(file: &str, species: Species, fits: impl Fn(&[&str]) -> bool) -> Option<&str> {
    let mut begin = None;
    let mut offset = 0;
    for line in file.split_inclusive('\n') {
        let is_new = line.trim_start().starts_with(|c: char| c.is_ascii_alphabetic() || c == '#');
        if let (Some(begin), true) = (begin, is_new) {
            return Some(file[begin..offset].trim_end());
        }
        let mut words = line.split_whitespace();
        if is_new && words.next() == Some(species.symbol()) && fits(&words.collect::<Vec<_>>()) {
            begin = Some(offset);
        }
        offset += line.len();
    }
    begin.map(|begin| file[begin..].trim_end())
}

/// Sum of the electrons by angular momentum, in an entry's second line.
fn valence(potential: &str) -> Option<f64> {
    let electrons: Vec<u32> =
        potential.lines().nth(1)?.split_whitespace().map(|n| n.parse().ok()).collect::<Option<_>>()?;
    electrons.iter().try_fold(0_u32, |sum, n| sum.checked_add(*n)).map(f64::from)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    const POTENTIAL: &str = "#\nSi GTH-BLYP-q4 GTH-BLYP\n    2    2\n 0.4\n#\nSi GTH-PBE-q4 GTH-PBE\n    2    2\n     0.44000000    1    -6.26928833\n#\nNi GTH-PBE-q18 GTH-PBE\n 4 6 8\n 0.3\n";
    const BASIS: &str = " Si DZVP-MOLOPT-SR-GTH DZVP-MOLOPT-SR-GTH-q4\n 1\n 2 0 2\n Ni DZVP-MOLOPT-SR-GTH DZVP-MOLOPT-SR-GTH-q10\n 1\n";

    fn settings(directory: &Path) -> Cp2kSettings {
        std::fs::write(directory.join(POTENTIALS), POTENTIAL).unwrap();
        std::fs::write(directory.join(BASES), BASIS).unwrap();
        Cp2kSettings { pseudopotentials: directory.to_owned(), ..Cp2kSettings::default() }
    }

    #[test]
    fn an_element_needs_a_potential_and_a_basis_for_as_many_electrons() {
        let directory = tempfile::tempdir().unwrap();
        let settings = settings(directory.path());
        let (silicon, nickel) = ("Si".parse().unwrap(), "Ni".parse().unwrap());
        let kinds = find(&settings).unwrap();
        assert_eq!(kinds.keys().copied().collect::<Vec<_>>(), [silicon]);
        assert_eq!(kinds[&silicon].valence, 4.0);
        let error = missing(nickel, &settings).to_string();
        assert!(error.starts_with("pseudopotential of Ni: no pseudopotential GTH-PBE in "), "{error}");

        let pseudopotential_variants = BTreeMap::from([(silicon, "GTH-BLYP".to_owned())]);
        let error =
            find(&Cp2kSettings { pseudopotential_variants, ..settings.clone() }).unwrap_err().to_string();
        assert!(error.contains("GTH-BLYP in `pseudopotential_variants` is not of PBE"), "{error}");
        let pseudopotential_variants = BTreeMap::from([(nickel, "GTH-PBE-q18".to_owned())]);
        assert!(find(&Cp2kSettings { pseudopotential_variants, ..settings }).is_err());
    }

    #[test]
    fn the_hash_is_of_the_entries_alone() {
        let directory = tempfile::tempdir().unwrap();
        let settings = settings(directory.path());
        let silicon = "Si".parse().unwrap();
        let hash = find(&settings).unwrap()[&silicon].entries.hash();
        std::fs::write(directory.path().join(POTENTIALS), POTENTIAL.replace("0.3\n", "0.5\n")).unwrap();
        assert_eq!(find(&settings).unwrap()[&silicon].entries.hash(), hash);
        std::fs::write(directory.path().join(POTENTIALS), POTENTIAL.replace("6.26928833", "6.3")).unwrap();
        assert_ne!(find(&settings).unwrap()[&silicon].entries.hash(), hash);
    }
}
