//! calmwalk's evaluation of GRACE beside gracemaker behind the bridge, on two tiny models with random weights, of one layer and of two. Needs
//! a Python with gracemaker: `CALMWALK_GRACEMAKER_PYTHON` (`.ci/loaders` makes it).

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use atoms::extxyz::Frame;
use atoms::{Evaluation, NeighbourList, Species, Structure, read_extxyz};
use bridge::{Device, PythonModel, PythonSettings};
use calm::{Artifact, Grades, Mixture};
use potentials::ModelWithFeatures;
use potentials::grace::{GraceModel, PullBack, Threads};
use tokio_util::sync::CancellationToken;

use crate::common::{config, deviation, stderr, succeed, write_frames};

fn gracemaker() -> PathBuf {
    let python = std::env::var_os("CALMWALK_GRACEMAKER_PYTHON");
    python.expect("CALMWALK_GRACEMAKER_PYTHON names a Python with gracemaker").into()
}

/// A model of random weights in the folder `kind`, and its export without an artifact.
fn make(here: &Path, kind: &str) {
    let script = "import sys\nfrom pathlib import Path\nimport make_gracemaker as make\n\
                  work = Path(sys.argv[1]).resolve()\nwork.mkdir()\nmake.untrained(sys.argv[1], work)\n\
                  make.program(work, 'grace_utils', '-p', 'model.yaml', '-c', 'checkpoint', 'export_kokkos', '-o', 'kokkos.npz')";
    let tests = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/tests");
    let made = Command::new(gracemaker())
        .args(["-c", script, kind])
        .env("PYTHONPATH", tests)
        .current_dir(here)
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", stderr(&made));
}

/// Frames of the demonstration, with every fifth atom copper in half of them, and a mixture for `kind` of all, which `graded.npz` has with the model.
fn make_mixture(here: &Path, kind: &str) -> Artifact {
    let copper: Species = "Cu".parse().unwrap();
    let mut frames = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    frames.truncate(12);
    write_frames(&here.join("pure.extxyz"), &frames[..1]);
    for frame in frames.iter_mut().step_by(2) {
        frame.structure.species.iter_mut().step_by(5).for_each(|species| *species = copper);
    }
    write_frames(&here.join("frames.extxyz"), &frames);
    let build = [
        "calm",
        "build",
        "frames.extxyz",
        "--candidates",
        "1",
        "--projection-dimension",
        "16",
        "--output",
        "calm.npz",
        "--embed",
        "graded.npz",
    ];
    succeed(here, build.into_iter().chain(["--model", &format!("{kind}/kokkos.npz")]));
    Artifact::load(here.join("calm.npz")).unwrap()
}

/// Everything that a biased step needs.
struct Step {
    energy: Evaluation,
    gamma: Vec<f64>,
    bias: PullBack,
}

fn step(model: Arc<dyn ModelWithFeatures>, mixture: &Mixture, structure: &Structure) -> Step {
    let mut list = NeighbourList::new(model.cutoff(), 0.0);
    list.update(structure).unwrap();
    let place = |species: &Species| model.elements().iter().position(|element| element == species).unwrap();
    let elements: Vec<_> = structure.species.iter().map(place).collect();
    let grade = |atoms: &[u32], features: &[f64], out: &mut [f64]| {
        let elements: Vec<_> = atoms.iter().map(|&atom| elements[atom as usize]).collect();
        let out = (!out.is_empty()).then_some(out);
        Grades::default().evaluate(mixture, &elements, features, out).unwrap();
    };
    let mut potential = Arc::clone(&model).evaluator(Threads::default());
    let (mut energy, mut bias) = (Evaluation::default(), PullBack::default());
    potential.evaluate_graded(structure, &list, &grade, &mut energy, Some(&mut bias)).unwrap();
    let mut grades = Grades::default();
    grades.evaluate(mixture, &elements, potential.features(), None).unwrap();
    Step { energy, gamma: grades.gamma, bias }
}

#[test]
fn a_biased_step_and_a_campaign_with_one_layer_are_those_of_gracemaker() {
    let directory = tempfile::tempdir().unwrap();
    make(directory.path(), "one");
    same_step(directory.path(), "one");
    same_campaign(directory.path(), "one");
}

#[test]
fn a_biased_step_with_two_layers_is_that_of_gracemaker() {
    let directory = tempfile::tempdir().unwrap();
    make(directory.path(), "two");
    same_step(directory.path(), "two");
}

/// Energies, forces, virials, γ, ∇Σγ and its virial of a structure of both elements, with one mixture. XLA compiles each function anew for
/// each number of bonds, which takes most of these tests.
fn same_step(here: &Path, kind: &str) {
    let Artifact { mixture, projection, .. } = make_mixture(here, kind);
    let native: Arc<dyn ModelWithFeatures> = Arc::new(GraceModel::load(&here.join("graded.npz")).unwrap());
    let settings = PythonSettings::new(&gracemaker(), "gracemaker", Some(&here.join(kind)));
    let settings = PythonSettings { cache: Some(here.join("compiled")), ..settings };
    let device = Device::start(settings, true, &CancellationToken::new(), |_| {}).map(Arc::new).unwrap();
    let python = PythonModel::local(vec![device]).unwrap().projected(projection).unwrap();
    let python: Arc<dyn ModelWithFeatures> = Arc::new(python);
    assert_eq!(native.elements(), python.elements());
    let structure = &read_extxyz(&here.join("frames.extxyz")).unwrap()[0].structure;
    let [ours, theirs] = [&native, &python].map(|model| step(Arc::clone(model), &mixture, structure));
    let pairs = [
        ("energies", &ours.energy.atomic_energies[..], &theirs.energy.atomic_energies[..]),
        ("forces", ours.energy.forces.as_flattened(), theirs.energy.forces.as_flattened()),
        ("virial", ours.energy.virial.as_flattened(), theirs.energy.virial.as_flattened()),
        ("γ", &ours.gamma, &theirs.gamma),
        ("∇Σγ", ours.bias.gradient.as_flattened(), theirs.bias.gradient.as_flattened()),
        ("virial of Σγ", ours.bias.virial.as_flattened(), theirs.bias.virial.as_flattened()),
    ];
    for (what, ours, theirs) in pairs {
        let error = deviation(ours, theirs);
        println!("{kind}: {what} {error:.1e}");
        assert!(error < 1e-10, "{kind}: {what} differ by {error:e} of the largest");
    }
}

/// The same campaign with either, in aluminium alone, with the files and the mixture of [`same_step`]: the same walks collect at the same
/// steps. Positions differ by rounding, which the dynamics amplify.
fn same_campaign(here: &Path, kind: &str) {
    let eam = config("data/Al_mm.eam.fs").display().to_string();
    let python = format!(
        "[potential.python]\nenvironment = {:?}\nadapter = \"gracemaker\"\nmax_batch = 1\ncache = \"compiled\"\n",
        gracemaker()
    );
    let export = format!("{kind}/kokkos.npz");
    let campaigns = [("native", export.as_str(), ""), ("gracemaker", kind, python.as_str())];
    let [native, gracemaker] = campaigns.map(|(name, model, python)| {
        let text = format!(
            "[campaign]\nrng_seed = 3\n[potential]\nmodel = {model:?}\n{python}[calm]\nartifact = \"calm.npz\"\n\
             [seed_structures]\nfiles = [\"pure.extxyz\"]\n\
             [walk]\ntemperature = 600.0\nbiased_steps = 120\nequilibration_steps = 10\ntau = 0.3\n\
             [collect]\ncriterion = {{ rule = \"maximum_grade\", threshold = 1.2 }}\n\
             update_target = {{ rule = \"maximum_grade\", target = 1.1 }}\nmin_interval = 10\nmax_per_walk = 10\n\
             [guard]\nzbl = {{ rule = \"uniform\", inner = 1.6, outer = 2.4 }}\n\
             [label]\nmethod = {{ potential = {{ kind = \"eam_fs\", file = {eam:?} }} }}\n\
             [run]\nwalkers = 1\nwalks_per_round = 1\n"
        );
        std::fs::write(here.join(format!("{name}.toml")), text).unwrap();
        succeed(here, ["run", &format!("{name}.toml"), "--directory", name]);
        let output = format!("{name}.extxyz");
        succeed(here, ["export", name, "--control", "--output", &output]);
        read_extxyz(&here.join(output)).unwrap()
    });
    assert!(
        native.len() > 5 && native.len() == gracemaker.len(),
        "{} and {}",
        native.len(),
        gracemaker.len()
    );
    for (ours, theirs) in native.iter().zip(&gracemaker) {
        assert_eq!(ours.info["step"], theirs.info["step"]);
        let positions = |frame: &Frame| frame.structure.positions.as_flattened().to_vec();
        let moved = deviation(&positions(ours), &positions(theirs));
        let grades =
            deviation(&ours.arrays["gamma"].reals().unwrap(), &theirs.arrays["gamma"].reals().unwrap());
        println!("step {:?}: positions {moved:.1e}, γ {grades:.1e}", ours.info["step"]);
        assert!(moved < 1e-9 && grades < 1e-8, "{moved:e} {grades:e}");
    }
}
