//! `calmwalk calm score` compared with gracemaker's values, and `calmwalk calm info`.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use atoms::extxyz::{ExtxyzValue, Frame};
use atoms::{Cell, NeighbourList, Species, Structure, read_extxyz};
use calm::{Artifact, Grades};
use npyz::NpyFile;
use npyz::npz::NpzArchive;

use crate::common::{calmwalk, config, deviation, refuse, succeed, write_frames};

/// gracemaker's numbers are in double precision; the radial functions here come from a table (error 10⁻¹²).
const TOLERANCE: f64 = 1e-9;

type Golden = NpzArchive<BufReader<File>>;

fn numbers(golden: &mut Golden, key: &str) -> Vec<f64> {
    golden.by_name(key).unwrap().unwrap().into_vec().unwrap()
}

fn structures(golden: &mut Golden) -> Vec<Structure> {
    let count = golden.by_name("names").unwrap().unwrap().shape()[0];
    let structure = |k: u64| {
        let key = |quantity| format!("s{k:02}_{quantity}");
        let atomic_numbers: Vec<i64> = golden.by_name(&key("numbers")).unwrap().unwrap().into_vec().unwrap();
        let periodic: Vec<bool> = golden.by_name(&key("pbc")).unwrap().unwrap().into_vec().unwrap();
        Structure {
            species: atomic_numbers.iter().map(|z| Species::from_atomic_number(*z as u8).unwrap()).collect(),
            positions: numbers(golden, &key("positions")).as_chunks().0.to_vec(),
            cell: Cell(numbers(golden, &key("cell")).as_chunks().0.to_vec().try_into().unwrap()),
            periodic: periodic.try_into().unwrap(),
        }
    };
    (0..count).map(structure).collect()
}

fn column(frame: &Frame, name: &str) -> Vec<f64> {
    frame.arrays[name].reals().unwrap()
}

/// γ_nbr from its definition (paper, Eq. 3) and a neighbour list.
fn neighbourhood_average(structure: &Structure, gamma: &[f64], cutoff: f64) -> Vec<f64> {
    let (mut neighbours, mut bonds) = (NeighbourList::new(cutoff, 0.0), Vec::new());
    neighbours.update(structure).unwrap();
    let average = |i| {
        neighbours.bonds_within(structure, i, cutoff, &mut bonds);
        let weights = bonds.iter().map(|bond| 0.5 * (1.0 + (std::f64::consts::PI * bond.r / cutoff).cos()));
        let (mut sum, mut weight) = (gamma[i], 1.0);
        for (w, bond) in weights.zip(&bonds) {
            sum += w * gamma[bond.atom as usize];
            weight += w;
        }
        sum / weight
    };
    (0..structure.len()).map(average).collect()
}

fn score_golden(model: &str, artifact: bool) {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let mut golden = NpzArchive::open(config(&format!("data/{model}/golden.npz"))).unwrap();
    let structures = structures(&mut golden);
    let cutoff = numbers(&mut golden, "cutoff")[0];
    let frames: Vec<Frame> = structures.into_iter().map(Frame::from).collect();
    write_frames(&here.join("in.extxyz"), &frames);
    let kokkos = config(&format!("data/{model}/kokkos.npz"));
    let gmm = config(&format!("data/{model}/gmm_artifacts.npz"));
    let mut arguments =
        vec!["calm", "score", "--model", kokkos.to_str().unwrap(), "in.extxyz", "--output", "out.extxyz"];
    arguments.extend(["--gradient", "--features", "z.npy"]);
    if artifact {
        arguments.extend(["--artifact", gmm.to_str().unwrap()]);
    }
    let printed = succeed(here, arguments);
    let (first, listed) = printed.split_once('\n').unwrap();
    assert_eq!(first, format!("wrote {} structures with grades to out.extxyz", frames.len()));

    let scored = read_extxyz(&here.join("out.extxyz")).unwrap();
    check_list(listed, &scored);
    assert_eq!(scored.len(), frames.len());
    for (k, (frame, input)) in scored.iter().zip(&frames).enumerate() {
        assert_eq!(frame.structure, input.structure);
        let labels = frame.labels().unwrap();
        let [[xx, xy, xz], [_, yy, yz], [.., zz]] = labels.stress.unwrap();
        for (quantity, found) in [
            ("energy", vec![labels.energy.unwrap()]),
            ("forces", labels.forces.unwrap().concat()),
            ("stress", vec![xx, yy, zz, yz, xz, xy]),
            ("sigma", column(frame, "sigma")),
            ("gamma", column(frame, "gamma")),
            ("dsigma_dr", column(frame, "gamma_gradient")),
        ] {
            let worst = deviation(&found, &numbers(&mut golden, &format!("s{k:02}_{quantity}")));
            assert!(worst < TOLERANCE, "{model} structure {k}: {quantity} deviates by {worst:.1e}");
        }
        let average = neighbourhood_average(&input.structure, &column(frame, "gamma"), cutoff);
        assert!(deviation(&column(frame, "gamma_nbr"), &average) < 1e-13);
        assert!(column(frame, "component").iter().all(|slot| *slot == 0.0));
    }
    check_features(&here.join("z.npy"), &scored, &gmm);
}

/// Grading the written features with the mixture gives the written grades.
fn check_features(path: &Path, scored: &[Frame], artifact: &Path) {
    let file = NpyFile::new(BufReader::new(File::open(path).unwrap())).unwrap();
    let artifact = Artifact::load(artifact).unwrap();
    let atoms: usize = scored.iter().map(|frame| frame.structure.len()).sum();
    assert_eq!(file.shape(), [atoms as u64, artifact.mixture.dimension() as u64]);
    assert_eq!(file.order(), npyz::Order::C);
    let (features, mut grades): (Vec<f64>, _) = (file.into_vec().unwrap(), Grades::default());
    grades.evaluate(&artifact.mixture, &vec![0; atoms], &features, None).unwrap();
    let gamma: Vec<f64> = scored.iter().flat_map(|frame| column(frame, "gamma")).collect();
    assert!(deviation(&grades.gamma, &gamma) < 1e-12);
}

#[test]
fn aluminium_is_graded_as_by_gracemaker() {
    score_golden("al_eam_1l", false);
}

#[test]
fn silicon_is_graded_as_by_gracemaker() {
    score_golden("si_sw_1l", true);
}

#[test]
fn the_artifact_gives_the_same_grades_as_the_export() {
    score_golden("al_eam_1l", true);
}

#[test]
fn what_a_frame_came_with_is_kept() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let mut labelled = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap().remove(0);
    labelled.info.insert("note".into(), "mine".into());
    // A cluster has no stress, and reference labels beside the model's values are kept.
    let mut cluster = labelled.clone();
    cluster.structure.periodic = [false; 3];
    cluster.info.remove("stress");
    cluster.info.insert("REF_energy".into(), (-1.5).into());
    write_frames(&here.join("in.extxyz"), &[labelled.clone(), cluster]);
    let kokkos = config("data/al_eam_1l/kokkos.npz");
    // The output may replace the input.
    succeed(here, ["calm", "score", "--model", kokkos.to_str().unwrap(), "in.extxyz", "-o", "in.extxyz"]);
    let scored = read_extxyz(&here.join("in.extxyz")).unwrap();
    let [first, second] = scored.as_slice() else { panic!("two frames") };
    assert_eq!(first.labels().unwrap(), labelled.labels().unwrap());
    assert_eq!(first.info["note"], ExtxyzValue::from("mine"));
    assert_eq!(first.info["config_type"], labelled.info["config_type"]);
    assert_ne!(first.info["energy"], first.info["REF_energy"]);
    assert_ne!(first.arrays["forces"], first.arrays["REF_forces"]);
    assert!(!first.arrays.contains_key("gamma_gradient"));
    assert_eq!(second.info["REF_energy"], ExtxyzValue::from(-1.5));
    assert!(!second.info.contains_key("stress") && !second.arrays.contains_key("REF_forces"));
}

#[test]
fn info_tells_model_and_artifact_apart() {
    let here = tempfile::tempdir().unwrap();
    let json = |file: &str| -> serde_json::Value {
        let text = succeed(here.path(), ["calm", "info", config(file).to_str().unwrap(), "--json"]);
        serde_json::from_str(&text).unwrap()
    };
    let model = json("data/al_eam_1l/kokkos.npz");
    assert_eq!((&model["kind"], &model["architecture"]), (&"model".into(), &"GRACE-1L".into()));
    assert_eq!((&model["cutoff"], &model["lmax"], &model["channels"]), (&6.5.into(), &3.into(), &8.into()));
    assert_eq!((&model["basis_dimension"], &model["feature_dimension"]), (&328.into(), &130.into()));
    // The error of derivatives, see `RadialPath::Table`.
    assert!(model["radial_tables"][0]["error"].as_f64().unwrap() < 1e-9);
    assert_eq!(
        (&model["mixture"]["schema"], &model["mixture"]["can_be_updated"]),
        (&6.into(), &false.into())
    );

    let artifact = json("data/al_eam_1l/gmm_artifacts.npz");
    assert_eq!((&artifact["kind"], &artifact["schema"]), (&"artifact".into(), &6.into()));
    assert_eq!((&artifact["elements"][0], &artifact["can_be_updated"]), (&"Al".into(), &true.into()));
    let component = &artifact["components"][0];
    assert_eq!((&component["element"], &component["count"]), (&"Al".into(), &5400.0.into()));
    assert!((component["threshold"].as_f64().unwrap() - 14.123097).abs() < 1e-6);
    assert!((component["condition_number"].as_f64().unwrap() - 195769.17).abs() < 0.1);

    let text = succeed(here.path(), ["calm", "info", config("data/si_sw_1l/kokkos.npz").to_str().unwrap()]);
    assert!(text.contains("GRACE-1L") && text.contains("Si") && text.contains(" Å"), "{text}");
}

const CELL: &str = "1\nLattice=\"4 0 0 0 4 0 0 0 4\" Properties=species:S:1:pos:R:3\nAl 0 0 0\n";

#[test]
fn what_cannot_be_read_is_named_with_its_line() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let kokkos = config("data/al_eam_1l/kokkos.npz");
    let score = |input: &str| {
        refuse(here, ["calm", "score", "--model", kokkos.to_str().unwrap(), input, "--output", "out.extxyz"])
    };
    let write = |name: &str, text: String| std::fs::write(here.join(name), text).unwrap();
    write("short.extxyz", CELL.to_owned() + "2\nProperties=species:S:1:pos:R:3\nAl 0 0 0\n");
    write("number.extxyz", CELL.replace("Al 0", "Al x"));
    write("empty.extxyz", String::new());
    write("other.cif", CELL.to_owned());
    let two = CELL.replacen('1', "2", 1);
    write("coincident.extxyz", two.clone() + "Al 0 0 0\n");
    write("near.extxyz", two + "Al 3.8 0 0\n");
    write("out.extxyz", "what was there".to_owned());
    for (file, place, reason) in [
        ("short.extxyz", "short.extxyz:7:", "ends after 1 of the 2 atoms"),
        ("number.extxyz", "number.extxyz:3:", "found 'x'"),
        ("empty.extxyz", "empty.extxyz", "no structures"),
        ("other.cif", "other.cif", "extended XYZ"),
        (
            "coincident.extxyz",
            "no structure can be graded; coincident.extxyz:1:",
            "atoms 0 and 1 are 0.000 Å apart; expected at least 0.4 Å",
        ),
        ("near.extxyz", "near.extxyz:1:", "atoms 0 and 1 are 0.200 Å apart"),
        ("missing.extxyz", "missing.extxyz", "cannot be opened"),
    ] {
        let message = score(file);
        assert!(message.contains(place) && message.contains(reason), "{message}");
    }
    assert_eq!(std::fs::read_to_string(here.join("out.extxyz")).unwrap(), "what was there");
    let left: Vec<_> = std::fs::read_dir(here).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left.len(), 7, "{left:?}");
}

#[test]
fn structures_that_cannot_be_graded_are_left_out() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let kokkos = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let near = CELL.replacen('1', "2", 1) + "Al 3.8 0 0\n";
    let all = [CELL, &CELL.replace("Al", "Si"), &near, CELL].concat();
    std::fs::write(here.join("in.extxyz"), &all).unwrap();
    let score = ["calm", "score", "--model", &kokkos, "in.extxyz", "--output"];
    let more = ["out.extxyz", "--features", "z.npy", "--table", "t.csv"];
    let output = calmwalk(here, score.iter().chain(&more));
    let said = crate::common::stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    let line = "left out 2 structures that cannot be graded; the first: in.extxyz:4: atom 0 is Si";
    assert!(said.contains(line), "{said}");
    let printed = String::from_utf8(output.stdout).unwrap();
    assert!(printed.starts_with("wrote 2 structures with grades to out.extxyz\n"), "{printed}");
    assert_eq!(read_extxyz(&here.join("out.extxyz")).unwrap().len(), 2);
    let features = NpyFile::new(BufReader::new(File::open(here.join("z.npy")).unwrap())).unwrap();
    assert_eq!(features.shape(), [2, 130]);
    let rows = std::fs::read_to_string(here.join("t.csv")).unwrap();
    let lines: Vec<_> = rows.lines().skip(1).map(|row| row.split(',').next().unwrap()).collect();
    assert_eq!(lines, ["1", "11"]);
    // They would be lost.
    let message = refuse(here, score.iter().chain(&["in.extxyz"]));
    assert!(message.contains("in.extxyz is the input, which has structures that were left out"), "{message}");
    assert_eq!(std::fs::read_to_string(here.join("in.extxyz")).unwrap(), all);
}

#[test]
fn packed_structures_are_graded_and_filtered() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let kokkos = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let two = CELL.replacen('1', "2", 1) + "Al 2.8 0 0\n";
    let text = [CELL, &two].concat();
    // A name without a known ending is read as extended XYZ.
    std::fs::write(here.join("plain"), &text).unwrap();
    std::fs::write(here.join("in.extxyz.zst"), zstd::encode_all(text.as_bytes(), 3).unwrap()).unwrap();
    let score = |input: &str, output: &str, more: &[&str]| {
        succeed(here, ["calm", "score", "--model", &kokkos, input, "--output", output].iter().chain(more));
        std::fs::read(here.join(output)).unwrap()
    };
    let expected = score("plain", "a.extxyz", &[]);
    assert!(score("in.extxyz.zst", "b.extxyz", &[]) == expected);
    score("in.extxyz.zst", "c.extxyz", &["--where", "atoms = 2"]);
    let found = read_extxyz(&here.join("c.extxyz")).unwrap();
    assert!(found.len() == 1 && found[0].structure.len() == 2);
    // The output is not packed.
    let message =
        refuse(here, ["calm", "score", "--model", &kokkos, "in.extxyz.zst", "--output", "in.extxyz.zst"]);
    assert!(message.contains("in.extxyz.zst is the input"), "{message}");
}

#[test]
fn outputs_replace_no_input() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for file in ["kokkos.npz", "gmm_artifacts.npz"] {
        std::fs::copy(config(&format!("data/al_eam_1l/{file}")), here.join(file)).unwrap();
    }
    std::fs::write(here.join("in.extxyz"), CELL).unwrap();
    let names = ["in.extxyz", "kokkos.npz", "gmm_artifacts.npz"];
    let contents = || names.map(|name| std::fs::read(here.join(name)).unwrap());
    let before = contents();
    let own = ["calm", "score", "--model", "kokkos.npz", "--artifact", "gmm_artifacts.npz", "in.extxyz"];
    for (outputs, reason) in [
        (&["--output", "gmm_artifacts.npz"][..], "gmm_artifacts.npz is the artifact"),
        (&["--output", "kokkos.npz"], "kokkos.npz is the model"),
        (&["--output", "o.extxyz", "--features", "kokkos.npz"], "kokkos.npz is the model"),
        (&["--output", "o.extxyz", "--features", "in.extxyz"], "in.extxyz is the input"),
        (&["--output", "o.extxyz", "--table", "in.extxyz"], "in.extxyz is the input"),
        (&["--output", "o.extxyz", "--json", "gmm_artifacts.npz"], "gmm_artifacts.npz is the artifact"),
        (
            &["--output", "o.extxyz", "--ensemble", "e.npz", "--json", "e.npz"],
            "e.npz is a model of the ensemble",
        ),
        (&["--output", "o.extxyz", "--baseline", "e.npz", "--json", "e.npz"], "e.npz is a file of baselines"),
        (&["--output", "o.extxyz", "--table", "o.extxyz"], "one file is named for two outputs"),
    ] {
        std::fs::copy(here.join("kokkos.npz"), here.join("e.npz")).unwrap();
        let message = refuse(here, own.iter().chain(outputs));
        assert!(message.contains(reason), "{message}");
    }
    assert!(contents() == before && !here.join("o.extxyz").exists());
}

#[test]
fn files_that_do_not_belong_together_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = |file: &str| config(file).to_str().unwrap().to_owned();
    let (kokkos, frames) = (path("data/al_eam_1l/kokkos.npz"), path("data/al_eam_1l/seed_frames.extxyz"));
    let score = |model: &str, artifact: &str| {
        let arguments =
            ["calm", "score", "--model", model, "--artifact", artifact, &frames, "--output", "o.extxyz"];
        refuse(here, arguments)
    };
    let message = score(&kokkos, &path("data/si_sw_1l/gmm_artifacts.npz"));
    assert!(message.contains("belongs to another model") && message.contains("Si"), "{message}");
    assert!(score(&kokkos, &path("data/al_eam_1l/golden.npz")).contains("golden.npz"));
    assert!(score(&path("data/Si.sw"), &kokkos).contains("Si.sw"));
    assert!(refuse(here, ["calm", "info", &path("data/Si.sw")]).contains("expected a NumPy .npz archive"));
    assert!(refuse(here, ["calm", "info", &path("data/al_eam_1l/golden.npz")]).contains("neither"));
    assert_eq!(calmwalk(here, ["calm", "score"]).status.code(), Some(2));
}

/// Checks what is printed of each structure against its grades.
fn check_list(listed: &str, scored: &[Frame]) {
    for frame in scored {
        let atoms::extxyz::ColumnData::Real(gamma) = &frame.arrays["gamma"].entries else {
            panic!("no numbers")
        };
        let worst = (0..gamma.len()).max_by(|a, b| gamma[*a].total_cmp(&gamma[*b])).unwrap();
        let above = gamma.iter().filter(|gamma| **gamma > 1.0).count();
        let expected = [format!("{:.2}", gamma[worst]), above.to_string(), worst.to_string()];
        let has = |line: &str| {
            line.split_whitespace().collect::<Vec<_>>().windows(3).any(|cells| cells == expected)
        };
        assert!(scored.len() > 20 || listed.lines().any(has), "{expected:?}\n{listed}");
    }
}
