//! Tests that do not need CP2K: the input, and the parsing of stored outputs (`tests/data/cp2k`).

use proptest::prelude::*;

use super::data::DataFileEntries;
use super::*;
use crate::FailureClass;

const INPUT: &str = include_str!("../../tests/data/cp2k/run.inp");
const OUTPUT: &str = include_str!("../../tests/data/cp2k/run.out");
/// The same input with only two electronic steps.
const SHORT: &str = include_str!("../../tests/data/cp2k/short.out");

/// The structure of the outputs.
fn silicon() -> Structure {
    let cell = atoms::Cell([[0.0, 2.75, 2.7], [2.72, 0.05, 2.75], [2.68, 2.72, -0.04]]);
    let positions = vec![[0.0; 3], [1.43, 1.33, 1.3]];
    Structure { species: vec!["Si".parse().unwrap(); 2], positions, cell, periodic: [true; 3] }
}

fn cp2k(settings: Cp2kSettings) -> Cp2k {
    let entries = DataFileEntries { potential: "Si GTH-PBE".into(), basis: "Si SZV".into() };
    let kind = AtomicKind { potential: "GTH-PBE".into(), valence: 4.0, entries };
    let environment = version_query::environment(&settings.environment);
    let kinds = BTreeMap::from([("Si".parse().unwrap(), kind)]);
    Cp2k { settings, environment, version: "2023.1".into(), kinds }
}

/// The settings that give `INPUT`.
fn settings() -> Cp2kSettings {
    Cp2kSettings {
        basis: "SZV-MOLOPT-SR-GTH".into(),
        cutoff: 1500.0,
        relative_cutoff: 300.0,
        density_tolerance: 1e-6,
        k_spacing: 10.0,
        ..Cp2kSettings::default()
    }
}

fn input(settings: Cp2kSettings, adjustments: &[RetryAdjustment]) -> String {
    let adjustments = BTreeSet::from_iter(adjustments.iter().copied());
    let input = cp2k(settings.clone()).input(&silicon(), &adjustments).unwrap();
    assert_eq!(input, cp2k(settings).input(&silicon(), &adjustments).unwrap());
    assert_eq!(input.command, ["cp2k", "-i", "run.inp", "-o", "run.out"]);
    String::from_utf8(input.files["run.inp"].clone()).unwrap()
}

fn parse(structure: &Structure, output: &str) -> Result<Option<CalculationResults>, Failure> {
    output::parse(structure, output, "2023.1")
}

#[test]
fn the_input_is_the_one_that_the_output_is_of() {
    assert_eq!(input(settings(), &[]), INPUT);
}

#[test]
fn adjustments_change_nothing_that_the_accuracy_depends_on() {
    let slower = input(settings(), &[RetryAdjustment::SlowerMixing]);
    assert_eq!(slower.replace("ALPHA 0.2", "ALPHA 0.4"), INPUT);
    let changed = input(settings(), &RetryAdjustment::ALL);
    let restored = changed
        .replace("MAX_SCF 600", "MAX_SCF 200")
        .replace("ALPHA 0.2", "ALPHA 0.4")
        .replace("NBROYDEN 4", "NBROYDEN 8")
        .replace("MAGNETIZATION 0.5", "MAGNETIZATION 1.0");
    assert!(slower != INPUT && changed != INPUT);
    assert_eq!(restored, INPUT);
}

#[test]
fn meshes_hold_the_point_gamma() {
    let mesh = |spacing| {
        let text = input(Cp2kSettings { k_spacing: spacing, ..settings() }, &[]);
        text.lines().find(|line| line.contains("SCHEME")).map(|line| line.trim().to_owned())
    };
    assert_eq!(mesh(10.0), None);
    assert_eq!(mesh(1.2).as_deref(), Some("SCHEME MACDONALD 2 2 2 0.25 0.25 0.25"));
    assert_eq!(mesh(0.8).as_deref(), Some("SCHEME MACDONALD 3 3 3 0.0 0.0 0.0"));
}

#[test]
fn calculations_read_the_entries_that_were_hashed() {
    let directory = tempfile::tempdir().unwrap();
    let write = |z: &str| {
        let potentials = format!("#\nSi GTH-PBE-q4 GTH-PBE\n 2 2\n 0.44 1 {z}\nO GTH-PBE\n 2 4\n");
        std::fs::write(directory.path().join(data::POTENTIALS), potentials).unwrap();
        let bases = "Si SZV-MOLOPT-SR-GTH\n 1\nO SZV-MOLOPT-SR-GTH\n 1\n";
        std::fs::write(directory.path().join(data::BASES), bases).unwrap();
    };
    write("-6.27");
    let settings = Cp2kSettings { pseudopotentials: directory.path().to_owned(), ..settings() };
    let prepared = || Cp2k { kinds: data::find(&settings).unwrap(), ..cp2k(settings.clone()) };
    let code = prepared();
    let entries = |code: &Cp2k| {
        let files = code.input(&silicon(), &BTreeSet::new()).unwrap().files;
        assert_eq!(String::from_utf8_lossy(&files["run.inp"]), INPUT);
        ["GTH_POTENTIALS", "BASIS_MOLOPT"].map(|name| String::from_utf8(files[name].clone()).unwrap())
    };
    let [potential, basis] = ["Si GTH-PBE-q4 GTH-PBE\n 2 2\n 0.44 1 -6.27", "Si SZV-MOLOPT-SR-GTH\n 1"];
    assert_eq!(entries(&code), [format!("{potential}\n"), format!("{basis}\n")]);
    let hash = blake3::hash(format!("{potential}\n{basis}").as_bytes()).to_hex().to_string();
    assert_eq!(code.identity()["pseudopotentials"]["Si"], hash);
    // A running campaign keeps the entries it started with; a new one has another protocol.
    write("-6.28");
    assert_eq!(entries(&code)[0], format!("{potential}\n"));
    assert_eq!(entries(&prepared())[0], format!("{}\n", potential.replace("-6.27", "-6.28")));
    assert_ne!(prepared().identity(), code.identity());
}

#[test]
fn what_changes_a_value_is_in_the_identity_and_nothing_else() {
    let identity = |settings: Cp2kSettings| cp2k(settings).identity();
    let plain = identity(settings());
    assert_eq!(
        identity(Cp2kSettings { max_scf_steps: 7, command: vec!["mpirun".into()], ..settings() }),
        plain
    );
    assert_ne!(identity(Cp2kSettings { relative_cutoff: 400.0, ..settings() }), plain);
    let error = Cp2kSettings { cutoff: 600.0, ..settings() }
        .prepare(&PassedEnvironment::default())
        .unwrap_err()
        .to_string();
    assert_eq!(error, "cutoff: found 600, expected at least 1000");
}

#[test]
fn an_output_is_a_label() {
    let label = parse(&silicon(), OUTPUT).unwrap().unwrap();
    let total = OUTPUT.split("Total energy:").nth(1).unwrap().split_whitespace().next().unwrap();
    let total: f64 = total.parse().unwrap();
    assert!((label.energy / HARTREE - total).abs() < 1e-9, "{label:?}");
    assert!(label.energy_without_smearing.unwrap() > label.energy);
    assert_eq!(label.forces.len(), 2);
    // CP2K prints the trace of a pressure, GPa.
    let trace = OUTPUT.split("1/3 Trace").nth(1).unwrap().split_whitespace().next().unwrap();
    let stress = label.stress.unwrap();
    let pressure = -(stress[0][0] + stress[1][1] + stress[2][2]) / 3.0 * atoms::units::GPA_PER_EV_A3;
    assert!((pressure - trace.parse::<f64>().unwrap()).abs() < 1e-6, "{pressure} {trace}");
    assert_eq!(label.magnetic_moments.unwrap().len(), 2);
    assert!(OUTPUT.contains(&format!("SCF run converged in {:5} steps", label.electronic_steps.unwrap())));
}

#[test]
fn an_output_that_is_not_converged_is_no_label() {
    let failure = parse(&silicon(), SHORT).unwrap_err();
    assert_eq!(failure.class, FailureClass::NotConverged);
    assert_eq!(failure.message, "not in 2 electronic steps");
}

#[test]
fn an_output_of_something_else_is_implausible() {
    let class = |structure: &Structure, output: &str| parse(structure, output).unwrap_err().class;
    let mut moved = silicon();
    moved.positions[1][0] += 1e-4;
    assert_eq!(class(&moved, OUTPUT), FailureClass::Implausible);
    let mut stretched = silicon();
    stretched.cell.0[0][1] += 4e-4;
    assert_eq!(class(&stretched, OUTPUT), FailureClass::Implausible);
    let mut other = silicon();
    other.species[0] = "Fe".parse().unwrap();
    assert_eq!(class(&other, OUTPUT), FailureClass::Implausible);
    assert_eq!(
        class(&silicon(), &OUTPUT.replace("version 2023.1", "version 2024.1")),
        FailureClass::OtherProgram
    );
}

#[test]
fn an_abort_is_reported() {
    let boxed = " *   ___    *\n *  /   \\   *\n * [ABORT]   *\n *  \\___/   found an unknown keyword NDIGITS   *\n *  O/| *\n * /| |   *\n ***************\n";
    let failure = parse(&silicon(), boxed).unwrap_err();
    assert_eq!(failure.class, FailureClass::Crashed);
    assert_eq!(failure.message, "CP2K says: found an unknown keyword NDIGITS");
}

proptest! {
    #[test]
    fn an_output_that_is_cut_off_is_never_a_label(end in 0..OUTPUT.len(), from_the_end in 1..800_usize) {
        for mut end in [end, OUTPUT.len() - from_the_end] {
            while !OUTPUT.is_char_boundary(end) {
                end -= 1;
            }
            prop_assert!(!matches!(parse(&silicon(), &OUTPUT[..end]), Ok(Some(_))), "cut at {end}");
        }
    }
}
