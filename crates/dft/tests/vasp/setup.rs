//! Errors in the setup are found before anything runs.

use std::collections::BTreeSet;
use std::path::Path;

use dft::vasp::{ElementTable, VaspSettings};
use dft::{DftBackend, SetupError};
use tempfile::TempDir;

use super::{alumina, potcar, settings};

#[test]
fn the_paper_s_protocol_is_the_default() {
    let settings: dft::DftSettings = serde_json::from_str(r#"{ "vasp": { "version": "5.4.4" } }"#).unwrap();
    let dft::DftSettings::Vasp(settings) = settings else { panic!("{}", settings.name()) };
    assert_eq!((settings.cutoff, settings.k_spacing, settings.smearing_width), (500.0, 0.125, 0.1));
    assert_eq!(
        (settings.smearing, settings.energy_tolerance, settings.spin_polarized),
        (dft::Smearing::Gaussian, 1e-6, true)
    );
    assert!(settings.tags.is_empty());
}

#[test]
fn the_identity_holds_what_changes_a_label() {
    let home = TempDir::new().unwrap();
    let first = settings(home.path(), "5.4.4", &["Al", "O"]);
    let identity = |settings: &VaspSettings| settings.prepare().unwrap().identity();
    let same = |change: &dyn Fn(&mut VaspSettings)| {
        let mut settings = first.clone();
        change(&mut settings);
        identity(&settings) == identity(&first)
    };
    assert!(same(&|settings| settings.max_scf_steps = 7));
    assert!(same(&|settings| settings.kpar = 4));
    assert!(same(&|settings| settings.command.push("-x".to_owned())));
    assert!(!same(&|settings| settings.version = "5.4".to_owned()));
    assert!(!same(&|settings| settings.cutoff = 520.0));
    assert!(!same(&|settings| settings.k_spacing = 0.2));
    assert!(!same(&|settings| settings.initial_magnetic_moments = [("O".parse().unwrap(), 2.0)].into()));
    assert!(!same(&|settings| drop(settings.tags.insert("LASPH".into(), ".TRUE.".into()))));
    assert_eq!(identity(&first)["pseudopotentials"]["O"]["title"], "PAW_PBE O 01Jan2000");
}

#[test]
fn the_identity_is_the_same_with_a_table_as_with_its_entries_written_out() {
    let home = TempDir::new().unwrap();
    let mut written_out = settings(home.path(), "5.4.4", &["Al", "O"]);
    written_out.initial_magnetic_moments = ["Al", "O"].map(|symbol| (symbol.parse().unwrap(), 0.6)).into();
    let mut with_table = VaspSettings {
        element_table: Some(ElementTable::MpRelaxSet),
        elements: ["Al", "O"].map(|symbol| symbol.parse().unwrap()).into(),
        pseudopotential_variants: [].into(),
        initial_magnetic_moments: [].into(),
        ..written_out.clone()
    };
    let identity = |settings: &VaspSettings| settings.prepare().unwrap().identity();
    assert_eq!(identity(&with_table), identity(&written_out));
    with_table.initial_magnetic_moments = [("O".parse().unwrap(), 2.0)].into();
    assert_ne!(identity(&with_table), identity(&written_out));
    // A table selects more potentials than there are.
    with_table.elements.push("Fe".parse().unwrap());
    let missing = with_table.prepare().unwrap_err().to_string();
    assert!(
        missing.contains("of Fe: the table MPRelaxSet selects Fe_pv, but none of ")
            && missing.ends_with("or list the elements that may occur in `elements`"),
        "{missing}"
    );
}

#[test]
fn calculations_read_the_potentials_that_were_hashed() {
    let home = TempDir::new().unwrap();
    let settings = settings(home.path(), "5.4.4", &["Al", "O"]);
    let potcar_of = |code: &dyn DftBackend| {
        let files = code.input(&alumina(), &BTreeSet::new()).unwrap().files;
        String::from_utf8(files["POTCAR"].clone()).unwrap()
    };
    let code = settings.prepare().unwrap();
    let expected = ["Al", "O"].map(|element| potcar(&format!("PAW_PBE {element} 01Jan2000"), element, 3.0));
    assert_eq!(potcar_of(&code), expected.concat());
    // A running campaign keeps the files it started with; a new one has another protocol.
    std::fs::write(home.path().join("O/POTCAR"), potcar("PAW_PBE O 02Jan2000", "O", 6.0)).unwrap();
    assert_eq!(potcar_of(&code), expected.concat());
    let new = settings.prepare().unwrap();
    assert!(potcar_of(&new).contains("PAW_PBE O 02Jan2000"));
    assert_ne!(new.identity(), code.identity());
}

#[test]
fn size_counts_valence_electrons_and_k_points() {
    let home = TempDir::new().unwrap();
    let settings = settings(home.path(), "5.4.4", &["Al", "O"]);
    std::fs::write(home.path().join("O/POTCAR"), potcar("PAW_PBE O 01Jan2000", "O", 6.0)).unwrap();
    let size = settings.prepare().unwrap().size(&alumina());
    // 2π |b| / 0.125: 12.31, 11.75, 10.93.
    assert_eq!((size.atoms, size.electrons, size.k_points), (3, 12.0, 13 * 12 * 11));
}

#[test]
fn what_is_missing_is_named() {
    let home = TempDir::new().unwrap();
    let fault = |change: &dyn Fn(&mut VaspSettings)| {
        let mut settings = settings(home.path(), "5.4.4", &["Al", "O"]);
        change(&mut settings);
        settings.prepare().unwrap_err()
    };
    let key = |error: SetupError| match error {
        SetupError::Setting { key, .. } => key,
        other => panic!("{other}"),
    };
    assert_eq!(key(fault(&|settings| settings.version.clear())), "version");
    assert_eq!(key(fault(&|settings| settings.pseudopotential_variants.clear())), "pseudopotential_variants");
    assert_eq!(key(fault(&|settings| settings.elements = vec!["Al".parse().unwrap()])), "elements");
    assert_eq!(key(fault(&|settings| settings.pseudopotentials = "".into())), "pseudopotentials");
    assert_eq!(key(fault(&|settings| settings.command.clear())), "command");
    assert_eq!(key(fault(&|settings| settings.cutoff = f64::NAN)), "cutoff");
    assert_eq!(key(fault(&|settings| settings.k_spacing = 0.0)), "k_spacing");
    assert_eq!(key(fault(&|settings| drop(settings.tags.insert("NSW".into(), "1".into())))), "tags");
    let program = fault(&|settings| settings.command = vec!["no-such-vasp".to_owned()]);
    assert!(matches!(program, SetupError::Program { .. }), "{program}");
    let missing = fault(&|settings| {
        drop(settings.pseudopotential_variants.insert("Fe".parse().unwrap(), "Fe_pv".into()))
    })
    .to_string();
    assert!(missing.contains(home.path().join("Fe_pv/POTCAR").to_str().unwrap()), "{missing}");
    let elsewhere =
        fault(&|settings| settings.pseudopotentials = Path::new("/no/such/place").into()).to_string();
    assert!(elsewhere.contains("/no/such/place/O/POTCAR"), "{elsewhere}");
    let code = settings(home.path(), "5.4.4", &["Al"]).prepare().unwrap();
    let species = ["Al", "Si"].map(|symbol| symbol.parse().unwrap());
    let unknown = code.supports(&species.into()).unwrap_err().to_string();
    assert!(unknown.contains("pseudopotential of Si"), "{unknown}");
}
