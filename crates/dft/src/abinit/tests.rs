//! Tests that do not need ABINIT: the input, and the parsing of stored outputs (`tests/data/abinit`).

use proptest::prelude::*;

use super::*;
use crate::{FailureClass, PinnedFile};

const INPUT: &str = include_str!("../../tests/data/abinit/run.abi");
const OUTPUT: &str = include_str!("../../tests/data/abinit/run.abo");
/// The same input with only three electronic steps.
const SHORT: &str = include_str!("../../tests/data/abinit/short.abo");

/// The structure of the outputs.
fn silicon() -> Structure {
    let cell = atoms::Cell([[0.0, 2.75, 2.7], [2.72, 0.05, 2.75], [2.68, 2.72, -0.04]]);
    let positions = vec![[0.0; 3], [1.43, 1.33, 1.3]];
    Structure { species: vec!["Si".parse().unwrap(); 2], positions, cell, periodic: [true; 3] }
}

fn abinit(settings: AbinitSettings) -> Abinit {
    let known = [("Si", 4.0, false), ("Fe", 16.0, true)].map(|(symbol, valence, paw)| {
        let path = format!("/{symbol}.{}", if paw { "xml" } else { "psp8" });
        let pinned = PinnedFile::fake(&path, &symbol.to_lowercase());
        (symbol.parse().unwrap(), Pseudopotential { pinned, valence, paw })
    });
    let environment = version_query::environment(&settings.environment);
    Abinit { settings, environment, version: "9.6.2".into(), pseudopotentials: known.into() }
}

/// The settings that give `INPUT`.
fn settings() -> AbinitSettings {
    AbinitSettings { cutoff: 200.0, k_spacing: 1.2, max_scf_steps: 60, ..AbinitSettings::default() }
}

fn input(settings: AbinitSettings, adjustments: &[RetryAdjustment]) -> String {
    let adjustments = BTreeSet::from_iter(adjustments.iter().copied());
    let input = abinit(settings.clone()).input(&silicon(), &adjustments).unwrap();
    assert_eq!(input, abinit(settings).input(&silicon(), &adjustments).unwrap());
    assert_eq!(input.command, ["abinit", "run.abi"]);
    String::from_utf8(input.files["run.abi"].clone()).unwrap()
}

fn parse(structure: &Structure, output: &str) -> Result<Option<CalculationResults>, Failure> {
    output::parse(structure, output, "", "9.6.2", Smearing::Gaussian)
}

/// Keywords with their values as one list of words.
fn words(input: &str) -> Vec<&str> {
    input.split_whitespace().collect()
}

#[test]
fn the_input_is_the_one_that_the_output_is_of() {
    let mut written = input(settings(), &[]);
    // The stored output came from the keywords in another order.
    let mut expected = INPUT.to_owned();
    for text in [&mut written, &mut expected] {
        let mut sorted = words(text);
        sorted.sort_unstable();
        *text = sorted.join(" ");
    }
    assert_eq!(written, expected);
}

#[test]
fn adjustments_change_nothing_that_the_accuracy_depends_on() {
    let (plain, changed) = (input(settings(), &[]), input(settings(), &RetryAdjustment::ALL));
    let added = ["diemix 0.25\n", "npulayit 15\n", "iscf 17\n", "nline 8\n", "nnsclo 2\n"];
    let mut restored = changed.replace("nstep 180\n", "nstep 60\n").replace("  0 0 0.5\n", "  0 0 1.0\n");
    for keyword in added {
        assert!(restored.contains(keyword), "{keyword}");
        restored = restored.replace(keyword, "");
    }
    assert_eq!(restored, plain);
}

#[test]
fn paw_setups_get_a_fine_grid_and_do_not_go_with_others() {
    let mut iron = silicon();
    iron.species = vec!["Fe".parse().unwrap(); 2];
    let code = abinit(settings());
    let text = code.input(&iron, &BTreeSet::new()).unwrap().files["run.abi"].clone();
    assert!(String::from_utf8(text).unwrap().contains("\npawecutdg 400.0 eV\n"));
    let both = BTreeSet::from(["Si", "Fe"].map(|symbol| symbol.parse().unwrap()));
    let error = code.supports(&both).unwrap_err().to_string();
    assert_eq!(
        error,
        "pseudopotential of Fe: /Fe.xml cannot be combined with /Si.psp8 of Si: one is PAW, the other is not"
    );
    let error = code.supports(&BTreeSet::from(["U".parse().unwrap()])).unwrap_err().to_string();
    assert!(error.starts_with("pseudopotential of U: no U.psp8 or U.xml in /usr/share/abinit"), "{error}");
}

#[test]
fn calculations_read_copies_of_what_was_hashed() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("mine.psp8");
    let before = "Si\n14.0 4.0 170510 zatom\n8 11 2 4\n";
    std::fs::write(&file, before).unwrap();
    let pseudopotential_variants = BTreeMap::from([("Si".parse().unwrap(), "mine.psp8".to_owned())]);
    let pseudopotentials = pseudopotentials::find(directory.path(), &pseudopotential_variants).unwrap();
    let settings = AbinitSettings {
        pseudopotentials: directory.path().to_owned(),
        pseudopotential_variants,
        ..settings()
    };
    let code = Abinit { pseudopotentials, ..abinit(settings) };
    let input = code.input(&silicon(), &BTreeSet::new()).unwrap();
    let text = String::from_utf8(input.files["run.abi"].clone()).unwrap();
    assert!(text.ends_with("pp_dirpath \"../data\"\npseudos \"Si.psp8\"\n"), "{text}");
    assert_eq!(input.data.keys().collect::<Vec<_>>(), ["Si.psp8"]);
    let hash = blake3::hash(before.as_bytes()).to_hex().to_string();
    assert_eq!(code.identity()["pseudopotentials"], json!({ "Si": hash }));
    assert_eq!(input.data["Si.psp8"].content().unwrap(), before.as_bytes());
    std::fs::write(&file, before.replace("170510", "170511")).unwrap();
    assert!(input.data["Si.psp8"].content().is_err());
}

#[test]
fn what_changes_a_value_is_in_the_identity_and_nothing_else() {
    let identity = |settings: AbinitSettings| abinit(settings).identity();
    let plain = identity(settings());
    assert_eq!(
        identity(AbinitSettings { max_scf_steps: 7, command: vec!["mpirun".into()], ..settings() }),
        plain
    );
    assert_ne!(identity(AbinitSettings { cutoff: 400.0, ..settings() }), plain);
    assert_ne!(identity(AbinitSettings { smearing_width: 0.2, ..settings() }), plain);
}

#[test]
fn an_output_is_a_label() {
    let label = parse(&silicon(), OUTPUT).unwrap().unwrap();
    // Hartree and bohr from the file.
    assert!((label.energy / 27.211386246 - -8.3613573076736).abs() < 1e-9);
    assert!(label.energy_without_smearing.unwrap() > label.energy);
    assert_eq!(label.electronic_steps, Some(10));
    assert_eq!(label.forces.len(), 2);
    // ABINIT also prints its own conversion.
    let (_, own) = OUTPUT.split_once(" cartesian forces (eV/Angstrom) at end:\n").unwrap();
    let own: Vec<f64> = own.split_whitespace().skip(1).take(3).map(|x| x.parse().unwrap()).collect();
    (0..3).for_each(|k| assert!((label.forces[0][k] - own[k]).abs() < 1e-6, "{label:?}"));
    // ABINIT's pressure, GPa, is −⅓ of the trace of the stress (tension positive).
    let stress = label.stress.unwrap();
    let pressure = -(stress[0][0] + stress[1][1] + stress[2][2]) / 3.0 * atoms::units::GPA_PER_EV_A3;
    assert!((pressure - 6.0701).abs() < 1e-4, "{pressure}");
    assert!((label.magnetisation.unwrap() - 0.249).abs() < 1e-3);
    assert_eq!(label.magnetic_moments.unwrap().len(), 2);
}

#[test]
fn an_output_that_is_not_converged_is_no_label() {
    let failure = parse(&silicon(), SHORT).unwrap_err();
    assert_eq!(failure.class, FailureClass::NotConverged);
    assert_eq!(failure.message, "not in 3 electronic steps");
}

#[test]
fn an_output_of_something_else_is_implausible() {
    let class = |structure: &Structure, output: &str| parse(structure, output).unwrap_err().class;
    let mut moved = silicon();
    moved.positions[1][0] += 1e-4;
    assert_eq!(class(&moved, OUTPUT), FailureClass::Implausible);
    let mut other = silicon();
    other.species[0] = "Fe".parse().unwrap();
    assert_eq!(class(&other, OUTPUT), FailureClass::Implausible);
    assert_eq!(class(&silicon(), &OUTPUT.replace("9.6.2", "9.10.1")), FailureClass::OtherProgram);
    let nan = OUTPUT.replacen("cartesian_forces: # hartree/bohr\n- [ ", "cartesian_forces: #\n- [ NaN,", 1);
    assert_eq!(class(&silicon(), &nan), FailureClass::Implausible);
    let occupied = " ITER STEP NUMBER    10\n  The minimal occupation factor is:   0.048.\n";
    let failure = output::parse(&silicon(), OUTPUT, occupied, "9.6.2", Smearing::Gaussian).unwrap_err();
    assert_eq!(failure.class, FailureClass::Implausible);
}

#[test]
fn printed_errors_are_reported() {
    let directory = tempfile::tempdir().unwrap();
    let printed = "--- !ERROR\nsrc_file: m_paw.F90\nmessage: |\n    PAW SPHERES ARE OVERLAPPING!\n    Action: change\n...\n";
    std::fs::write(directory.path().join("stdout"), printed).unwrap();
    let failure = abinit(settings()).read(&silicon(), directory.path(), Exit::Code(14)).unwrap_err();
    assert_eq!(failure.class, FailureClass::BadInput);
    assert_eq!(failure.message, "ABINIT says: PAW SPHERES ARE OVERLAPPING! Action: change");
    let nothing = tempfile::tempdir().unwrap();
    let failure = abinit(settings()).read(&silicon(), nothing.path(), Exit::Signal(9)).unwrap_err();
    assert_eq!(failure.class, FailureClass::OutOfMemory);
}

proptest! {
    #[test]
    fn an_output_that_is_cut_off_is_never_a_label(end in 0..OUTPUT.len(), from_the_end in 1..800_usize) {
        for end in [end, OUTPUT.len() - from_the_end] {
            prop_assert!(!matches!(parse(&silicon(), &OUTPUT[..end]), Ok(Some(_))), "cut at {end}");
        }
    }

    #[test]
    fn an_output_with_a_hole_is_read_without_panic(begin in 0..OUTPUT.len(), length in 1..2000_usize) {
        let end = (begin + length).min(OUTPUT.len());
        let _ = parse(&silicon(), &format!("{}{}", &OUTPUT[..begin], &OUTPUT[end..]));
    }
}
