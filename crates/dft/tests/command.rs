//! A shell script as labelling command, from the structure to the results.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use atoms::{Cell, Structure};
use dft::{
    CalculationResults, DftBackend, DftSettings, Exit, Failure, FailureClass, PassedEnvironment,
    RetryAdjustment, SetupError,
};

/// Copies the columns of the structure and adds the label; exits with the given code.
const SCRIPT: &str = r#"
{ head -n 1 structure.extxyz
  sed -n 2p structure.extxyz | sed 's/pos:R:3/pos:R:3:forces:R:3:magmoms:R:1/' | tr '\n' ' '
  cat more; echo
  tail -n +3 structure.extxyz | while read -r line; do echo "$line 0.5 -0.25 1e-3 2.0"; done
} > label.extxyz
echo "$CALMWALK_RETRY_ADJUSTMENTS" > adjustments
exit "$(cat code)"
"#;

const INFO: &str = r#"energy=-1.5 free_energy=-1.625 REF_energy=7 stress="0.1 0 0 0 0.2 0 0 0 0.3""#;

fn oxide() -> Structure {
    Structure {
        species: ["Al", "O", "Al"].map(|symbol| symbol.parse().unwrap()).to_vec(),
        positions: vec![[0.1, 0.2, 1.0 / 3.0], [2.0, 9.0, 4.0], [1.0, 1.0, 1.0]],
        cell: Cell([[5.0, 0.0, 0.0], [1.0, 5.0, 0.0], [0.0, 0.25, 5.0]]),
        periodic: [true, true, false],
    }
}

/// Settings for [`SCRIPT`] with this end of the comment line and this exit code.
fn settings(directory: &Path, info: &str, code: u8) -> dft::command::CommandSettings {
    for (name, content) in [("label.sh", SCRIPT), ("more", info), ("code", &code.to_string())] {
        std::fs::write(directory.join(name), content).unwrap();
    }
    dft::command::CommandSettings {
        command: ["sh", "label.sh"].map(str::to_owned).to_vec(),
        files: ["label.sh", "more", "code"].map(|name| directory.join(name)).to_vec(),
        version: "1".to_owned(),
    }
}

/// Writes the input, runs the command and reads the output.
fn run(
    code: &dyn DftBackend,
    structure: &Structure,
    adjustments: &[RetryAdjustment],
    place: &Path,
) -> Result<CalculationResults, Failure> {
    let input = code.input(structure, &BTreeSet::from_iter(adjustments.iter().copied()))?;
    for (name, content) in &input.files {
        std::fs::write(place.join(name), content).unwrap();
    }
    let (program, arguments) = input.command.split_first().unwrap();
    let status =
        Command::new(program).args(arguments).envs(&input.environment).current_dir(place).status().unwrap();
    code.read(structure, place, Exit::Code(status.code().unwrap()))
}

fn label(info: &str, code: u8) -> Result<CalculationResults, Failure> {
    let (home, place) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    run(&settings(home.path(), info, code).prepare().unwrap(), &oxide(), &[], place.path())
}

#[test]
fn a_script_makes_a_label() {
    let (home, place) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let code = settings(home.path(), INFO, 0).prepare().unwrap();
    let adjustments = [RetryAdjustment::OtherMoments, RetryAdjustment::MoreSteps];
    let calculated = run(&code, &oxide(), &adjustments, place.path()).unwrap();
    let expected = CalculationResults {
        energy: -1.625,
        energy_without_smearing: Some(-1.5),
        forces: vec![[0.5, -0.25, 1e-3]; 3],
        stress: Some([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3]]),
        magnetic_moments: Some(vec![2.0; 3]),
        magnetisation: Some(6.0),
        electronic_steps: None,
    };
    assert_eq!(calculated, expected);
    assert_eq!(
        std::fs::read_to_string(place.path().join("adjustments")).unwrap(),
        "more_steps,other_moments\n"
    );
    assert_eq!(code.size(&oxide()).atoms, 3);
    assert_eq!(label("energy=2", 0).unwrap().stress, None);
}

#[test]
fn the_exit_code_tells_the_class() {
    use FailureClass::*;
    for (code, class) in [(1, Crashed), (2, Crashed), (3, NotConverged), (4, OutOfMemory), (5, BadInput)] {
        assert_eq!(label(INFO, code).unwrap_err().class, class, "{code}");
    }
    let (home, place) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let code = settings(home.path(), INFO, 0).prepare().unwrap();
    run(&code, &oxide(), &[], place.path()).unwrap();
    for (exit, class) in [
        (Exit::Signal(9), OutOfMemory),
        (Exit::Signal(11), Crashed),
        (Exit::TimeLimit, TimeLimit),
        (Exit::LostNode, NodeFailure),
    ] {
        assert_eq!(code.read(&oxide(), place.path(), exit).unwrap_err().class, class);
    }
}

#[test]
fn what_is_no_label_is_not_believed() {
    for info in ["", "REF_energy=1", "energy=nan", "energy=1 free_energy=T", "energy=1 stress=\"1 2 3\""] {
        assert!(label(info, 0).is_err(), "{info}");
    }
    let (home, place) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let code = settings(home.path(), INFO, 0).prepare().unwrap();
    run(&code, &oxide(), &[], place.path()).unwrap();
    let mut moved = oxide();
    moved.positions[1][0] += 1e-3;
    let failure = code.read(&moved, place.path(), Exit::Code(0)).unwrap_err();
    assert_eq!(failure.class, FailureClass::Implausible);
    assert!(failure.message.starts_with("atom 1 is at"), "{failure}");
    let whole = std::fs::read_to_string(place.path().join("label.extxyz")).unwrap();
    std::fs::write(place.path().join("label.extxyz"), whole.repeat(2)).unwrap();
    assert!(code.read(&oxide(), place.path(), Exit::Code(0)).is_err());
    std::fs::remove_file(place.path().join("label.extxyz")).unwrap();
    let failure = code.read(&oxide(), place.path(), Exit::Code(0)).unwrap_err();
    assert_eq!(failure.class, FailureClass::Crashed);
}

#[test]
fn a_file_cut_anywhere_is_no_label() {
    let (home, place) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let code = settings(home.path(), INFO, 0).prepare().unwrap();
    run(&code, &oxide(), &[], place.path()).unwrap();
    let path = place.path().join("label.extxyz");
    let whole = std::fs::read(&path).unwrap();
    for length in 0..whole.len() {
        std::fs::write(&path, &whole[..length]).unwrap();
        assert!(
            code.read(&oxide(), place.path(), Exit::Code(0)).is_err(),
            "{length} of {} bytes",
            whole.len()
        );
    }
}

#[test]
fn files_are_among_the_paths() {
    let text = r#"{ "command": { "command": ["sh", "a"], "files": ["a", "b"], "version": "1" } }"#;
    let mut settings: DftSettings = serde_json::from_str(text).unwrap();
    assert_eq!(settings.paths(), [&mut PathBuf::from("a"), &mut PathBuf::from("b")]);
    assert_eq!(settings.name(), "command");
    assert!(settings.prepare(&PassedEnvironment::default()).is_err());
    assert!(serde_json::from_str::<DftSettings>(&text.replace("files", "file")).is_err());
}

#[test]
fn the_identity_is_that_of_command_files_and_version() {
    let home = tempfile::tempdir().unwrap();
    let first = settings(home.path(), INFO, 0);
    let identity = first.prepare().unwrap().identity();
    assert_eq!(first.prepare().unwrap().identity(), identity);
    assert_ne!(settings(home.path(), "energy=1", 0).prepare().unwrap().identity(), identity);
    let mut other = settings(home.path(), INFO, 0);
    other.version = "2".to_owned();
    assert_ne!(other.prepare().unwrap().identity(), identity);
}

#[test]
fn calculations_read_the_files_that_were_hashed() {
    let home = tempfile::tempdir().unwrap();
    let more = |code: &dyn DftBackend| code.input(&oxide(), &BTreeSet::new()).unwrap().files["more"].clone();
    let code = settings(home.path(), "energy=1", 0).prepare().unwrap();
    // A running campaign keeps the files it started with; a new one has another protocol.
    let new = settings(home.path(), "energy=2", 0).prepare().unwrap();
    assert_eq!([more(&code), more(&new)], [b"energy=1", b"energy=2"]);
    assert_ne!(new.identity(), code.identity());
}

#[test]
fn what_is_missing_is_found_before_anything_runs() {
    let home = tempfile::tempdir().unwrap();
    let fault = |change: &dyn Fn(&mut dft::command::CommandSettings)| {
        let mut settings = settings(home.path(), INFO, 0);
        change(&mut settings);
        settings.prepare().unwrap_err()
    };
    let program =
        |settings: &mut dft::command::CommandSettings, name: &str| settings.command[0] = name.to_owned();
    for name in ["no-such-program", "/no/such/program", "./label.sh"] {
        let found = fault(&|settings| program(settings, name));
        assert!(matches!(&found, SetupError::Program { program, .. } if program == name), "{found}");
    }
    assert!(matches!(
        fault(&|settings| settings.command.clear()),
        SetupError::Setting { key: "command", .. }
    ));
    let missing = fault(&|settings| settings.files.push("/no/such/file".into())).to_string();
    assert!(missing.starts_with("files: found /no/such/file, expected a file that can be read"), "{missing}");
    let twice = fault(&|settings| settings.files.push(settings.files[0].clone())).to_string();
    assert!(twice.contains("'label.sh'"), "{twice}");
}
