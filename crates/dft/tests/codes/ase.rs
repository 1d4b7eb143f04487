//! Real ASE calculators: EMT, which is part of ASE, and GPAW, with the Python in `CALMWALK_PYTHON` or Debian's.

use std::collections::BTreeSet;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::Command;

use atoms::cell::{Vec3, add};
use atoms::{Cell, Structure};
use dft::ase::{Ase, AseSettings};
use dft::{
    CalculationResults, DftBackend, Exit, Failure, FailureClass, PassedEnvironment, RetryAdjustment,
    SetupError,
};
use tempfile::TempDir;

fn python() -> String {
    std::env::var("CALMWALK_PYTHON").unwrap_or_else(|_| "/usr/bin/python3".to_owned())
}

fn settings(place: &TempDir, calculator: &str) -> AseSettings {
    let path = place.path().join("my_calculator.py");
    std::fs::write(&path, calculator).unwrap();
    AseSettings { command: vec![python()], calculator: path, ..AseSettings::default() }
}

fn prepared(calculator: &str) -> Ase {
    settings(&TempDir::new().unwrap(), calculator).prepare(&PassedEnvironment::default()).unwrap()
}

/// Writes the input, runs the script and reads the output.
fn run(
    code: &dyn DftBackend,
    structure: &Structure,
    adjustments: &[RetryAdjustment],
) -> Result<CalculationResults, Failure> {
    let place = TempDir::new().unwrap();
    let input = code.input(structure, &adjustments.iter().copied().collect::<BTreeSet<_>>())?;
    for (name, content) in &input.files {
        std::fs::write(place.path().join(name), content).unwrap();
    }
    let output = Command::new(&input.command[0])
        .args(&input.command[1..])
        .envs(&input.environment)
        .current_dir(place.path())
        .output()
        .unwrap();
    for (name, content) in [("stdout", &output.stdout), ("stderr", &output.stderr)] {
        std::fs::write(place.path().join(name), content).unwrap();
    }
    let exit = output.status.code().map_or_else(|| Exit::Signal(output.status.signal().unwrap()), Exit::Code);
    code.read(structure, place.path(), exit)
}

/// A distorted, sheared alloy with mixed order of elements.
fn alloy() -> Structure {
    let mut positions = Vec::new();
    for i in 0..8_u8 {
        let corner = [i & 1, i >> 1 & 1, i >> 2 & 1].map(f64::from);
        let x = f64::from(i);
        let shift = [(1.3 * x).sin(), (2.1 * x).cos(), (0.7 + 1.9 * x).sin()].map(|s| 0.15 * s);
        positions.push(add(corner.map(|c| 2.6 * c), shift));
    }
    Structure {
        species: ["Al", "Cu", "Au", "Cu", "Al", "Ni", "Cu", "Al"]
            .map(|symbol| symbol.parse().unwrap())
            .to_vec(),
        positions,
        cell: Cell([[5.3, 0.0, 0.0], [0.4, 5.2, 0.1], [-0.2, 0.3, 5.4]]),
        periodic: [true; 3],
    }
}

const EMT: &str =
    "from ase.calculators.emt import EMT\nversion = 'EMT of ASE'\ndef calculator():\n    return EMT()\n";

/// ASE's results without our script.
fn emt_alone(structure: &Structure) -> (f64, Vec<Vec3>, [f64; 6]) {
    let script = "import json, sys\nfrom ase import Atoms\nfrom ase.calculators.emt import EMT\n\
                  s, x, c = json.load(sys.stdin)\na = Atoms(s, positions=x, cell=c, pbc=True, calculator=EMT())\n\
                  print(json.dumps([a.get_potential_energy(), a.get_forces().tolist(), a.get_stress().tolist()]))";
    let place = TempDir::new().unwrap();
    let path = place.path().join("structure.json");
    let text = serde_json::to_string(&(&structure.species, &structure.positions, &structure.cell)).unwrap();
    std::fs::write(&path, text).unwrap();
    let input = std::fs::File::open(path).unwrap();
    let output = Command::new(python()).args(["-c", script]).stdin(input).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn emt_gives_the_numbers_that_ase_gives() {
    let found = run(&prepared(EMT), &alloy(), &[]).unwrap();
    let (energy, forces, [xx, yy, zz, yz, xz, xy]) = emt_alone(&alloy());
    assert_eq!((found.energy, found.energy_without_smearing), (energy, Some(energy)));
    assert_eq!(found.forces, forces);
    assert_eq!(found.stress, Some([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]));
    assert!(forces.iter().flatten().any(|force| force.abs() > 0.5));
}

/// As in docs/dft-codes.md.
const LABEL: &str = "from ase.io import read, write\nfrom ase.calculators.emt import EMT\natoms = read('structure.extxyz')\n\
                     atoms.calc = EMT()\natoms.get_forces(), atoms.get_stress()\nwrite('label.extxyz', atoms)\n";

#[test]
fn a_command_that_uses_ase_gives_the_same_but_for_the_digits_of_its_file() {
    let place = TempDir::new().unwrap();
    let path = place.path().join("label.py");
    std::fs::write(&path, LABEL).unwrap();
    let settings = dft::command::CommandSettings {
        command: vec![python(), "label.py".to_owned()],
        files: vec![path],
        version: "EMT".to_owned(),
    };
    let found = run(&settings.prepare().unwrap(), &alloy(), &[]).unwrap();
    let expected = run(&prepared(EMT), &alloy(), &[]).unwrap();
    let numbers = |label: &CalculationResults| {
        let energies = [label.energy, label.energy_without_smearing.unwrap()];
        [energies.as_slice(), &label.forces.concat(), &label.stress.unwrap().concat()].concat()
    };
    let (found, expected) = (numbers(&found), numbers(&expected));
    assert_eq!(found.len(), expected.len());
    let close = found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6);
    assert!(close, "{found:?}\n{expected:?}");
}

/// ∂E/∂x by central differences, where `change` adds to x.
fn derivative(code: &Ase, step: f64, change: impl Fn(&mut Structure, f64)) -> f64 {
    let energy = |x: f64| {
        let mut structure = alloy();
        change(&mut structure, x);
        run(code, &structure, &[]).unwrap().energy
    };
    (energy(step) - energy(-step)) / (2.0 * step)
}

#[test]
fn emt_forces_and_stress_are_derivatives_of_its_energy() {
    let code = prepared(EMT);
    let found = run(&code, &alloy(), &[]).unwrap();
    for (atom, axis) in [(0, 0), (3, 1), (6, 2)] {
        let force = -derivative(&code, 1e-4, |structure, x| structure.positions[atom][axis] += x);
        assert!((force - found.forces[atom][axis]).abs() < 1e-6, "{force} {:?}", found.forces[atom]);
    }
    for (i, k) in [(0, 0), (0, 1), (1, 2)] {
        let strain = |vector: &mut Vec3, x: f64| {
            let [before_i, before_k] = [vector[i], vector[k]];
            vector[i] += 0.5 * x * before_k;
            vector[k] += 0.5 * x * before_i;
        };
        let slope = derivative(&code, 1e-4, |structure, x| {
            structure.cell.0.iter_mut().chain(&mut structure.positions).for_each(|vector| strain(vector, x));
        });
        let stress = slope / alloy().cell.volume();
        assert!((stress - found.stress.unwrap()[i][k]).abs() < 1e-6, "{stress} {:?}", found.stress);
    }
}

#[test]
fn open_directions_stay_open_and_have_no_stress() {
    let slab = Structure { periodic: [true, true, false], ..alloy() };
    let found = run(&prepared(EMT), &slab, &[]).unwrap();
    assert_eq!(found.stress, None);
    assert_ne!(found.energy, emt_alone(&alloy()).0);
}

/// EMT with a modification.
fn class_of(calculator: &str) -> FailureClass {
    run(&prepared(&format!("{EMT}{calculator}")), &alloy(), &[]).unwrap_err().class
}

#[test]
fn failures_are_reported() {
    use FailureClass::*;
    let raising = |error: &str| {
        let text = "class C(EMT):\n    def calculate(self, *a, **k):\n        raise ERROR('no')\ndef calculator():\n    return C()\n";
        class_of(&text.replace("ERROR", error))
    };
    assert_eq!(raising("MemoryError"), OutOfMemory);
    assert_eq!(raising("__import__('ase').calculators.calculator.SCFError"), NotConverged);
    assert_eq!(raising("type('KohnShamConvergenceError', (Exception,), {})"), NotConverged);
    assert_eq!(raising("RuntimeError"), Crashed);
    assert_eq!(class_of("def converged(calculator):\n    return False\n"), NotConverged);
    let flagged = "def calculator():\n    c = EMT()\n    c.converged = False\n    return c\n";
    assert_eq!(class_of(flagged), NotConverged);
    let not_a_number = "class C(EMT):\n    def calculate(self, *a, **k):\n        super().calculate(*a, **k)\n        \
                        self.results['forces'][0, 0] = float('nan')\ndef calculator():\n    return C()\n";
    assert_eq!(class_of(not_a_number), Implausible);
    let moving = "class C(EMT):\n    def calculate(self, *a, **k):\n        super().calculate(*a, **k)\n        \
                  self.atoms.positions[0] += 0.1\ndef calculator():\n    return C()\n";
    assert_eq!(class_of(moving), Implausible);
    assert_eq!(class_of("import os\ndef calculator():\n    os._exit(3)\n"), Crashed);
    assert_eq!(class_of("import os\ndef calculator():\n    os.kill(os.getpid(), 11)\n"), Crashed);
}

#[test]
fn adjustments_and_moments_reach_the_calculator() {
    let text = format!(
        "{EMT}def calculator(adjustments):\n    assert adjustments == {{'more_steps', 'other_moments'}}, adjustments\n    return C()\n\
         class C(EMT):\n    def calculate(self, atoms, *a):\n        super().calculate(atoms, *a)\n        \
         self.results['magmoms'] = atoms.get_initial_magnetic_moments()\n        self.results['magmom'] = 4.5\n"
    );
    let place = TempDir::new().unwrap();
    let mut settings = settings(&place, &text);
    settings.initial_magnetic_moments = [("Cu".parse().unwrap(), 3.0)].into();
    let code = settings.prepare(&PassedEnvironment::default()).unwrap();
    let found = run(&code, &alloy(), &[RetryAdjustment::OtherMoments, RetryAdjustment::MoreSteps]).unwrap();
    assert_eq!(found.magnetic_moments, Some(vec![0.5, 1.5, 0.5, 1.5, 0.5, 0.5, 1.5, 0.5]));
    assert_eq!(found.magnetisation, Some(4.5));
    assert!(run(&code, &alloy(), &[]).is_err());
}

#[test]
fn the_identity_is_that_of_file_and_versions() {
    let identity = prepared(EMT).identity();
    assert_eq!(identity["version"], "EMT of ASE");
    assert!(identity["ase"].as_str().unwrap().starts_with("3."), "{identity}");
    assert_eq!(prepared(EMT).identity(), identity);
    assert_ne!(prepared(&EMT.replace("EMT()", "EMT( )")).identity(), identity);
}

#[test]
fn what_is_missing_is_found_before_anything_is_calculated() {
    let place = TempDir::new().unwrap();
    let mut missing = settings(&place, EMT);
    missing.calculator = Path::new("/no/such/file.py").to_owned();
    let fault = missing.prepare(&PassedEnvironment::default()).unwrap_err();
    assert!(
        matches!(&fault, SetupError::Setting { key: "calculator", found, .. } if found == "/no/such/file.py"),
        "{fault}"
    );
    let fault = settings(&place, "def calculate():\n    pass\n")
        .prepare(&PassedEnvironment::default())
        .unwrap_err()
        .to_string();
    assert!(fault.contains("defines no function calculator()"), "{fault}");
    let fault = settings(&place, "import no_such_module\n")
        .prepare(&PassedEnvironment::default())
        .unwrap_err()
        .to_string();
    assert!(fault.contains("no_such_module"), "{fault}");
    let command = vec!["no-such-python".to_owned()];
    let fault =
        AseSettings { command, ..settings(&place, EMT) }.prepare(&PassedEnvironment::default()).unwrap_err();
    assert!(matches!(fault, SetupError::Program { .. }), "{fault}");
}

/// A minimal plane-wave basis for silicon, with few steps at first.
const GPAW: &str = "from gpaw import GPAW, PW\nimport gpaw\nversion = 'GPAW ' + gpaw.__version__\n\
                    def calculator(adjustments):\n    return GPAW(mode=PW(200), xc='PBE', kpts={'size': (2, 2, 2), 'gamma': True},\n        \
                    occupations={'name': 'fermi-dirac', 'width': 0.1}, convergence={'energy': 1e-7, 'density': 1e-6},\n        \
                    symmetry={'point_group': False}, maxiter=60 if 'more_steps' in adjustments else 3, txt='-')\n";

fn silicon() -> Structure {
    Structure {
        species: vec!["Si".parse().unwrap(); 2],
        positions: vec![[0.0, 0.0, 0.0], [1.4575, 1.2575, 1.3575]],
        cell: Cell([[0.0, 2.715, 2.715], [2.715, 0.0, 2.715], [2.715, 2.715, 0.0]]),
        periodic: [true; 3],
    }
}

#[test]
fn gpaw_converges_with_more_steps_and_its_forces_are_derivatives_of_its_free_energy() {
    let code = prepared(GPAW);
    assert!(code.identity()["version"].as_str().unwrap().starts_with("GPAW "));
    assert_eq!(run(&code, &silicon(), &[]).unwrap_err().class, FailureClass::NotConverged);
    let calculate = |structure: &Structure| run(&code, structure, &[RetryAdjustment::MoreSteps]).unwrap();
    let found = calculate(&silicon());
    assert_ne!(Some(found.energy), found.energy_without_smearing);
    assert!(found.electronic_steps.is_some_and(|steps| steps > 3), "{found:?}");
    let energy = |x: f64| {
        let mut structure = silicon();
        structure.positions[1][0] += x;
        calculate(&structure).energy
    };
    let force = -(energy(0.01) - energy(-0.01)) / 0.02;
    assert!(force.abs() > 0.5, "{force}");
    assert!((force - found.forces[1][0]).abs() < 5e-3, "{force} {found:?}");
}
