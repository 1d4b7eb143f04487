//! Tests that do not need Quantum ESPRESSO: the input, and the parsing of stored outputs (`tests/data/espresso`).

use proptest::prelude::*;

use super::*;
use crate::{FailureClass, PinnedFile};

const INPUT: &str = include_str!("../../tests/data/espresso/run.in");
/// Version 6.7 with Debian's `Si.pbe-rrkj.UPF`.
const OUTPUT: &str = include_str!("../../tests/data/espresso/run.out");
/// The same input with only three electronic steps.
const SHORT: &str = include_str!("../../tests/data/espresso/short.out");

/// The structure of the outputs.
fn silicon() -> Structure {
    let cell = atoms::Cell([[0.0, 2.75, 2.7], [2.72, 0.05, 2.75], [2.68, 2.72, -0.04]]);
    let positions = vec![[0.0; 3], [1.43, 1.33, 1.3]];
    Structure { species: vec!["Si".parse().unwrap(); 2], positions, cell, periodic: [true; 3] }
}

fn espresso(settings: EspressoSettings) -> Espresso {
    let known = [("H", 1.0), ("Si", 4.0), ("Fe", 16.0)].map(|(symbol, valence)| {
        let pinned = PinnedFile::fake(&format!("/{symbol}.UPF"), &symbol.to_lowercase());
        (symbol.parse().unwrap(), Ok(UpfFile { pinned, valence }))
    });
    let environment = version_query::environment(&settings.environment);
    Espresso { settings, environment, version: "6.7MaX".into(), pseudopotentials: known.into() }
}

/// The settings that give `INPUT`.
fn settings() -> EspressoSettings {
    EspressoSettings { cutoff: 200.0, k_spacing: 1.2, max_scf_steps: 60, ..EspressoSettings::default() }
}

fn input_of(structure: &Structure, settings: EspressoSettings, adjustments: &[RetryAdjustment]) -> String {
    let adjustments = BTreeSet::from_iter(adjustments.iter().copied());
    let input = espresso(settings.clone()).input(structure, &adjustments).unwrap();
    assert_eq!(input, espresso(settings).input(structure, &adjustments).unwrap());
    assert_eq!(input.command, ["pw.x", "-in", "run.in"]);
    String::from_utf8(input.files["run.in"].clone()).unwrap()
}

fn input(settings: EspressoSettings, adjustments: &[RetryAdjustment]) -> String {
    input_of(&silicon(), settings, adjustments)
}

fn parse(structure: &Structure, output: &str) -> Result<Option<CalculationResults>, Failure> {
    output::parse(structure, output, "6.7MaX", &settings())
}

#[test]
fn the_input_is_the_one_that_the_output_is_of() {
    assert_eq!(input(settings(), &[]), INPUT);
}

#[test]
fn adjustments_change_nothing_that_the_accuracy_depends_on() {
    let changed = input(settings(), &RetryAdjustment::ALL);
    let mut restored = changed
        .replace("electron_maxstep = 180", "electron_maxstep = 60")
        .replace("starting_magnetization(1) = 0.125", "starting_magnetization(1) = 0.25");
    for added in ["  mixing_beta = 0.2\n", "  diagonalization = 'cg'\n", "  mixing_mode = 'local-TF'\n"] {
        assert!(restored.contains(added), "{added}");
        restored = restored.replace(added, "");
    }
    assert_eq!(restored, INPUT);
}

#[test]
fn moments_are_fractions_of_the_valence_electrons() {
    let mut hydride = silicon();
    hydride.species = ["Fe", "H"].map(|symbol| symbol.parse().unwrap()).to_vec();
    let moments = BTreeMap::from([("Fe".parse().unwrap(), -4.0)]);
    let magnetic = EspressoSettings { initial_magnetic_moments: moments, ..settings() };
    let text = input_of(&hydride, magnetic, &[]);
    // Ascending atomic number. From version 7.3 on, 1 would be a moment.
    assert!(text.contains("  ntyp = 2\n  nbnd = 18\n"), "{text}");
    let expected = "starting_magnetization(1) = 0.999\n  starting_magnetization(2) = -0.25\n";
    assert!(text.contains(expected), "{text}");
    assert!(text.contains("ATOMIC_SPECIES\n  H 1.0 H.UPF\n  Fe 1.0 Fe.UPF\n"), "{text}");
    assert!(text.contains("ATOMIC_POSITIONS alat\n  Fe 0.0 0.0 0.0\n  H 1.35"), "{text}");
    let plain = input(EspressoSettings { spin_polarized: false, ..settings() }, &[]);
    assert!(!plain.contains("nspin") && !plain.contains("magnetization"), "{plain}");

    let too_many = BTreeMap::from([("Si".parse().unwrap(), 5.0)]);
    let code = espresso(EspressoSettings { initial_magnetic_moments: too_many, ..settings() });
    let error = code.supports(&BTreeSet::from(["Si".parse().unwrap()])).unwrap_err().to_string();
    assert_eq!(error, "initial_magnetic_moments: found Si = 5, expected at most its 4 valence electrons");
}

#[test]
fn what_cannot_be_calculated_is_refused_at_once() {
    let error =
        espresso(settings()).supports(&BTreeSet::from(["U".parse().unwrap()])).unwrap_err().to_string();
    assert!(error.starts_with("pseudopotential of U: no U.UPF or U.*.UPF in /usr/share/espresso"), "{error}");
    let prepared =
        EspressoSettings { density_cutoff: Some(700.0), ..settings() }.prepare(&Default::default());
    assert_eq!(prepared.unwrap_err().to_string(), "density_cutoff: found 700, expected at least 800");
    let mut many = silicon();
    many.species = (1..=11).map(|number| Species::from_atomic_number(number).unwrap()).collect();
    many.positions = (0..11).map(|atom| [f64::from(atom), 0.0, 0.0]).collect();
    many.cell = atoms::Cell::orthorhombic(20.0, 5.0, 5.0);
    let failure = espresso(settings()).input(&many, &BTreeSet::new()).unwrap_err();
    assert_eq!(failure.class, FailureClass::BadInput);
    assert_eq!(failure.message, "11 elements, more than the 10 of pw.x");
}

#[test]
fn calculations_read_copies_of_what_was_hashed() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("Si.mine.UPF");
    let before = "<PP_HEADER element=\"Si\" pseudo_type=\"NC\" functional=\"PBE\" z_valence=\"4.0\"/>\n";
    std::fs::write(&file, before).unwrap();
    let pseudopotentials = pseudopotentials::find(directory.path(), &BTreeMap::new()).unwrap();
    let code = Espresso { pseudopotentials, ..espresso(settings()) };
    let input = code.input(&silicon(), &BTreeSet::new()).unwrap();
    assert_eq!(String::from_utf8(input.files["run.in"].clone()).unwrap(), INPUT);
    assert_eq!(input.data.keys().collect::<Vec<_>>(), ["Si.UPF"]);
    let hash = blake3::hash(before.as_bytes()).to_hex().to_string();
    assert_eq!(code.identity()["pseudopotentials"], json!({ "Si": hash }));
    assert_eq!(input.data["Si.UPF"].content().unwrap(), before.as_bytes());
    std::fs::write(&file, before.replace("NC", "US")).unwrap();
    assert!(input.data["Si.UPF"].content().is_err());
}

#[test]
fn what_changes_a_value_is_in_the_identity_and_nothing_else() {
    let identity = |settings: EspressoSettings| espresso(settings).identity();
    let plain = identity(settings());
    let same = EspressoSettings { max_scf_steps: 7, command: vec!["mpirun".into()], ..settings() };
    assert_eq!(identity(same), plain);
    // Eight times the cutoff is the default.
    assert_eq!(identity(EspressoSettings { density_cutoff: Some(1600.0), ..settings() }), plain);
    assert_ne!(identity(EspressoSettings { density_cutoff: Some(800.0), ..settings() }), plain);
    assert_ne!(identity(EspressoSettings { smearing_width: 0.2, ..settings() }), plain);
}

#[test]
fn an_output_is_a_label() {
    let label = parse(&silicon(), OUTPUT).unwrap().unwrap();
    assert!((label.energy / RYDBERG - -15.54675621).abs() < 1e-12, "{label:?}");
    // The internal energy is U = F + TS, the zero-smearing limit halfway between the two.
    let internal =
        OUTPUT.split("internal energy E=F+TS    =").nth(1).unwrap().split_whitespace().next().unwrap();
    let halfway = 0.5 * (label.energy / RYDBERG + internal.parse::<f64>().unwrap());
    assert!((label.energy_without_smearing.unwrap() / RYDBERG - halfway).abs() < 1e-8, "{label:?}");
    assert_eq!(label.electronic_steps, Some(7));
    // 25.711034 eV/Å are 1 Ry/bohr.
    let expected = [0.01511566, 0.00320809, -0.00992212].map(|force| 25.711_034 * force);
    assert_eq!(label.forces.len(), 2);
    (0..3).for_each(|k| assert!((label.forces[0][k] - expected[k]).abs() < 1e-7, "{label:?}"));
    (0..3).for_each(|k| assert_eq!(label.forces[1][k], -label.forces[0][k]));
    // The program's own pressure, kbar, compression positive, with two decimals.
    let stress = label.stress.unwrap();
    let pressure = -(stress[0][0] + stress[1][1] + stress[2][2]) / 3.0 * atoms::units::GPA_PER_EV_A3 * 10.0;
    assert!((pressure - 74.20).abs() < 0.01, "{pressure}");
    assert!(stress[1][2] > 0.0 && stress[1][2] == stress[2][1], "{stress:?}");
    assert_eq!(label.magnetisation, Some(0.25));
    assert_eq!(label.magnetic_moments, Some(vec![0.0375, 0.0376]));
}

#[test]
fn moments_of_version_7_are_read() {
    let old = [
        "     Magnetic moment per site:",
        "     atom:    1    charge:    1.7210    magn:    0.0375    constr:    0.0000",
    ];
    let second = "     atom:    2    charge:    1.7241    magn:    0.0376    constr:    0.0000";
    let new = [
        "     Magnetic moment per site  (integrated on atomic sphere of radius R)",
        "     atom   1 (R=0.357)  charge=  1.7210  magn= -0.0375",
    ];
    let output = OUTPUT.replace("v.6.7MaX", "v.7.2").replace(old[0], new[0]).replace(old[1], new[1]);
    let output = output.replace(second, "     atom   2 (R=0.357)  charge=  1.7241  magn=  0.0376");
    let label = output::parse(&silicon(), &output, "7.2", &settings()).unwrap().unwrap();
    assert_eq!(label.magnetic_moments, Some(vec![-0.0375, 0.0376]));
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
    moved.positions[1][0] += 1e-5;
    assert_eq!(class(&moved, OUTPUT), FailureClass::Implausible);
    let mut stretched = silicon();
    stretched.cell.0[0][1] += 1e-5;
    assert_eq!(class(&stretched, OUTPUT), FailureClass::Implausible);
    let mut other = silicon();
    other.species[0] = "Fe".parse().unwrap();
    assert_eq!(class(&other, OUTPUT), FailureClass::Implausible);
    assert_eq!(class(&silicon(), &OUTPUT.replace("v.6.7MaX", "v.7.2")), FailureClass::OtherProgram);
    let nan = OUTPUT.replacen("force =     0.01511566", "force =            NaN", 1);
    assert_eq!(class(&silicon(), &nan), FailureClass::Implausible);
    let stars = OUTPUT.replacen("force =     0.01511566", "force = **************", 1);
    assert_eq!(class(&silicon(), &stars), FailureClass::Implausible);
    let occupied =
        OUTPUT.replacen("     0.0000   0.0000\n\n          k =", "     0.0000   0.0480\n\n          k =", 1);
    assert_ne!(occupied, OUTPUT);
    let failure = parse(&silicon(), &occupied).unwrap_err();
    assert_eq!(failure.message, "the highest band is occupied: there are too few bands");
}

#[test]
fn errors_have_the_class_of_their_cause() {
    let (banner, _) = OUTPUT.split_once("     This program").unwrap();
    let frame = format!(" {}", "%".repeat(78));
    let failure = |routine: &str, message: &str| {
        let text = format!(
            "{banner}\n{frame}\n     Error in routine {routine} (1):\n     {message}\n{frame}\n\n     stopping ...\n"
        );
        parse(&silicon(), &text).unwrap_err()
    };
    for (routine, message, class) in [
        ("c_bands", "too many bands are not converged", FailureClass::NotConverged),
        (" cdiaghg ", " problems computing cholesky ", FailureClass::NotConverged),
        ("rdiaghg", "S matrix not positive definite", FailureClass::NotConverged),
        (" diag_bands ", " cannot allocate h_diag ", FailureClass::OutOfMemory),
        ("check_atoms", "atoms #   1 and #   2 overlap!", FailureClass::BadInput),
        ("readpp", "file ../data/Si.UPF not found", FailureClass::Crashed),
        ("diropn", "wrong record length", FailureClass::Crashed),
    ] {
        let found = failure(routine, message);
        assert_eq!(found.class, class, "{found}");
        assert_eq!(found.message, format!("pw.x says: {} ({})", message.trim(), routine.trim()));
    }
}

#[test]
fn how_it_ended_matters_without_an_output() {
    let directory = tempfile::tempdir().unwrap();
    let class = |exit| espresso(settings()).read(&silicon(), directory.path(), exit).unwrap_err().class;
    assert_eq!(class(Exit::Signal(9)), FailureClass::OutOfMemory);
    assert_eq!(class(Exit::TimeLimit), FailureClass::TimeLimit);
    assert_eq!(class(Exit::Code(1)), FailureClass::Crashed);
    // Complete, but for the last lines.
    let (cut, _) = OUTPUT.split_once("   JOB DONE.").unwrap();
    std::fs::write(directory.path().join("stdout"), cut).unwrap();
    assert_eq!(class(Exit::LostNode), FailureClass::NodeFailure);
    std::fs::write(directory.path().join("stdout"), OUTPUT).unwrap();
    let whatever = espresso(settings()).read(&silicon(), directory.path(), Exit::Code(1)).unwrap();
    assert_eq!(whatever, parse(&silicon(), OUTPUT).unwrap().unwrap());
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
