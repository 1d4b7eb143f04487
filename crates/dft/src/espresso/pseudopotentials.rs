//! Pseudopotentials of Quantum ESPRESSO: files in the format UPF (versions 1 and 2), several of which may be for one
//! element.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use atoms::Species;

use super::upf::UpfHeader;
use crate::{PinnedFile, SetupError};

/// A pseudopotential.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct UpfFile {
    /// Its file.
    pub pinned: PinnedFile,
    /// Number of valence electrons.
    pub valence: f64,
}

/// What the directory has for an element: a pseudopotential, or why none is selected.
pub(super) type SelectedUpf = Result<UpfFile, SetupError>;

/// The pseudopotential of each element for which the directory has files. A file that the settings do not
/// name may be for another functional, which matters only if a structure contains its element.
///
/// # Errors
/// A directory that cannot be read, and each fault of a file that `pseudopotential_variants` names.
pub(super) fn find(
    directory: &Path,
    pseudopotential_variants: &BTreeMap<Species, String>,
) -> Result<BTreeMap<Species, SelectedUpf>, SetupError> {
    let names = upf_names(directory)?;
    let mut found = BTreeMap::new();
    for species in (1..=118).filter_map(|number| Species::from_atomic_number(number).ok()) {
        if let Some(name) = pseudopotential_variants.get(&species) {
            let path = directory.join(name);
            if !path.is_file() {
                return Err(missing(species, directory, pseudopotential_variants));
            }
            found.insert(species, Ok(read(species, path)?));
            continue;
        }
        let of_species: Vec<&String> = names.iter().filter(|name| is_of(name, species)).collect();
        if !of_species.is_empty() {
            found.insert(species, select(species, directory, &of_species));
        }
    }
    Ok(found)
}

/// The error for an element without a pseudopotential.
pub(super) fn missing(
    species: Species,
    directory: &Path,
    pseudopotential_variants: &BTreeMap<Species, String>,
) -> SetupError {
    let usual = || format!("{species}.UPF or {species}.*.UPF");
    let sought = pseudopotential_variants.get(&species).cloned().unwrap_or_else(usual);
    SetupError::missing_pseudopotential(species, &sought, directory)
}

/// Names of the UPF files in the directory, sorted.
fn upf_names(directory: &Path) -> Result<Vec<String>, SetupError> {
    let wrong = |error: std::io::Error| SetupError::Setting {
        key: "pseudopotentials",
        found: format!("{}: {error}", directory.display()),
        expected: "a directory of pseudopotentials, such as Si.UPF".to_owned(),
    };
    let mut names = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(wrong)? {
        // A name that is not UTF-8 cannot be selected.
        names.extend(entry.map_err(wrong)?.file_name().into_string().ok());
    }
    names.retain(|name| name.to_ascii_lowercase().ends_with(".upf") && directory.join(name).is_file());
    names.sort_unstable();
    Ok(names)
}

/// Whether the name begins with the symbol, in any case: `Si.UPF`, `si_pbe_v1.uspp.F.UPF`, `Si-pbe.upf`.
fn is_of(name: &str, species: Species) -> bool {
    name.split(['.', '_', '-']).next().is_some_and(|begin| begin.eq_ignore_ascii_case(species.symbol()))
}

/// Selects `Si.UPF`, or else the only file that can be used.
fn select(species: Species, directory: &Path, names: &[&String]) -> SelectedUpf {
    let plain = species.symbol().len() + ".upf".len();
    if let Some(name) = names.iter().find(|name| name.len() == plain) {
        return read(species, directory.join(name));
    }
    let (mut usable, mut faults) = (Vec::new(), Vec::new());
    for name in names {
        match read(species, directory.join(name)) {
            Ok(file) => usable.push((*name, file)),
            Err(fault) => faults.push(fault),
        }
    }
    let several = || {
        let listed = usable.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", ");
        let reason = format!(
            "{} has several, {listed}: name one in `pseudopotential_variants`, such as {species} = \"{}\"",
            directory.display(),
            usable.first().map_or("", |(name, _)| name)
        );
        SetupError::Pseudopotential { species, reason }
    };
    if usable.len() > 1 {
        return Err(several());
    }
    match (usable.pop(), faults.into_iter().next()) {
        (Some((_, file)), _) => Ok(file),
        (None, Some(fault)) => Err(fault),
        (None, None) => Err(missing(species, directory, &BTreeMap::new())),
    }
}

fn read(species: Species, path: PathBuf) -> SelectedUpf {
    let shown = path.display().to_string();
    let wrong =
        |reason: String| SetupError::Pseudopotential { species, reason: format!("{shown}: {reason}") };
    let (pinned, content) =
        PinnedFile::open(path).map_err(|error| wrong(format!("cannot be read: {error}")))?;
    let valence = UpfHeader::read(&content).and_then(|header| header.valence_of(species)).map_err(wrong)?;
    Ok(UpfFile { pinned, valence })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(element: &str, functional: &str, valence: u32) -> String {
        format!(
            "<UPF version=\"2.0.1\">\n<PP_HEADER element=\"{element}\" pseudo_type=\"NC\" relativistic=\"scalar\" \
             functional=\"{functional}\" z_valence=\"{valence}.000E+000\"/>\n"
        )
    }

    fn species(symbol: &str) -> Species {
        symbol.parse().unwrap()
    }

    /// A directory with these files.
    fn directory(files: &[(&str, String)]) -> tempfile::TempDir {
        let directory = tempfile::tempdir().unwrap();
        for (name, content) in files {
            std::fs::write(directory.path().join(name), content).unwrap();
        }
        directory
    }

    #[test]
    fn the_only_file_for_pbe_is_selected() {
        let lda = header("Si", "SLA PZ NOGX NOGC", 4);
        let library = directory(&[
            ("Si.pbe-n-rrkjus_psl.1.0.0.UPF", header("Si", "PBE", 4)),
            ("Si.pz-vbc.UPF", lda.clone()),
            ("al_pbe_v1.uspp.F.upf", header("Al", " SLA PW PBX PBC", 3)),
            ("As.pz-bhs.UPF", lda.replace("Si", "As")),
            ("readme", String::new()),
        ]);
        let found = find(library.path(), &BTreeMap::new()).unwrap();
        assert_eq!(found.len(), 3);
        assert_eq!(found[&species("Si")].as_ref().unwrap().valence, 4.0);
        assert!(found[&species("Al")].as_ref().unwrap().pinned.path().ends_with("al_pbe_v1.uspp.F.upf"));
        // Only structures with arsenic need it.
        let error = found[&species("As")].as_ref().unwrap_err().to_string();
        assert!(error.starts_with("pseudopotential of As: ") && error.contains("not for PBE"), "{error}");
    }

    #[test]
    fn of_several_files_one_must_be_named() {
        let library = directory(&[
            ("Fe.pbe-nd.UPF", header("Fe", "PBE", 8)),
            ("Fe.pbe-spn.UPF", header("Fe", "PBE", 16)),
            ("Ni.UPF", header("Ni", "PBE", 10)),
            ("Ni.pbe-spn.UPF", header("Ni", "PBE", 18)),
        ]);
        let found = find(library.path(), &BTreeMap::new()).unwrap();
        assert_eq!(found[&species("Ni")].as_ref().unwrap().valence, 10.0);
        let error = found[&species("Fe")].as_ref().unwrap_err().to_string();
        let expected = "has several, Fe.pbe-nd.UPF, Fe.pbe-spn.UPF: name one in `pseudopotential_variants`, such as \
                        Fe = \"Fe.pbe-nd.UPF\"";
        assert!(error.starts_with("pseudopotential of Fe: ") && error.ends_with(expected), "{error}");
        let named = BTreeMap::from([(species("Fe"), "Fe.pbe-spn.UPF".to_owned())]);
        assert_eq!(find(library.path(), &named).unwrap()[&species("Fe")].as_ref().unwrap().valence, 16.0);
    }

    #[test]
    fn what_is_missing_names_element_and_directory() {
        let library = directory(&[("Si.UPF", header("Al", "PBE", 3))]);
        let variants = BTreeMap::from([(species("Zn"), "Zn-sp.UPF".to_owned())]);
        let error = find(library.path(), &variants).unwrap_err().to_string();
        let expected = format!("pseudopotential of Zn: no Zn-sp.UPF in {}", library.path().display());
        assert!(error.starts_with(&expected), "{error}");
        // A file that is named must be right, a file that was found only if it is needed.
        let found = find(library.path(), &BTreeMap::new()).unwrap();
        let error = found[&species("Si")].as_ref().unwrap_err().to_string();
        assert!(error.ends_with("Si.UPF: is for Al, not for Si"), "{error}");
        let named = BTreeMap::from([(species("Si"), "Si.UPF".to_owned())]);
        assert_eq!(find(library.path(), &named).unwrap_err().to_string(), error);
        let error = find(&library.path().join("none"), &BTreeMap::new()).unwrap_err().to_string();
        assert!(error.starts_with("pseudopotentials: found ") && error.contains("No such file"), "{error}");
    }
}
