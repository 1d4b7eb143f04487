//! `calmwalk select`, and labelling of its output by a campaign (`import --queue`).

use std::fs;
use std::path::Path;

use atoms::extxyz::Frame;
use atoms::read_extxyz;
use serde_json::Value as Json;

use crate::common::campaign::Small;
use crate::common::{calmwalk, config, random, refuse, stderr, succeed, write_frames};

fn file(path: &str) -> String {
    config(&format!("data/al_eam_1l/{path}")).display().to_string()
}

/// Training frames whose atoms are displaced by up to 0.05, 0.1, … Å, and whose info has the number `n`.
fn pool(path: &Path, count: usize) -> Vec<Frame> {
    let seeds = read_extxyz(&config("data/aluminium_seeds.extxyz")).unwrap();
    let frame = |n: usize| {
        let mut frame = seeds[n % seeds.len()].clone();
        let scale = 0.05 * (1 + n % 7) as f64;
        for (k, x) in frame.structure.positions.iter_mut().flatten().enumerate() {
            let unit = random((1000 * n + k) as u64) as f64 / u64::MAX as f64;
            *x += scale * (2.0 * unit - 1.0);
        }
        frame.info.insert("n".to_owned(), (n as i64).into());
        frame
    };
    let frames: Vec<_> = (0..count).map(frame).collect();
    write_frames(path, &frames);
    frames
}

fn select(here: &Path, arguments: &[&str]) -> Json {
    let (model, artifact) = (file("kokkos.npz"), file("gmm_artifacts.npz"));
    let own = ["select", "--model", &model, "--artifact", &artifact, "--output", "out.extxyz", "--json"];
    serde_json::from_str(&succeed(here, own.iter().chain(arguments))).unwrap()
}

fn refused(here: &Path, arguments: &[&str]) -> String {
    let (model, artifact) = (file("kokkos.npz"), file("gmm_artifacts.npz"));
    let own = ["select", "--model", &model, "--artifact", &artifact];
    refuse(here, own.iter().chain(arguments))
}

fn number(frame: &Frame, key: &str) -> f64 {
    frame.info[key].number().unwrap()
}

#[test]
fn selected_structures_keep_their_frames_whatever_threads_and_memory() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let frames = pool(&here.join("pool.extxyz"), 12);
    let found = select(here, &["pool.extxyz", "--threads", "1"]);
    let selected = read_extxyz(&here.join("out.extxyz")).unwrap();
    let picks = found["picks"].as_array().unwrap();
    assert!(selected.len() > 1 && picks.len() == selected.len());
    for (rank, (frame, pick)) in selected.iter().zip(picks).enumerate() {
        let n = number(frame, "n") as usize;
        assert_eq!((&frame.structure, &frame.info["name"]), (&frames[n].structure, &frames[n].info["name"]));
        assert_eq!(frame.info["source_file"].text(), Some("pool.extxyz"));
        assert_eq!(frame.info["selection_strategy"].text(), Some("greedy"));
        assert_eq!(number(frame, "source_frame") as usize, n);
        assert_eq!(
            (number(frame, "selection_rank"), pick["rank"].as_u64()),
            ((rank + 1) as f64, Some(rank as u64 + 1))
        );
        assert_eq!(Some(number(frame, "gamma_max")), pick["gamma_max"].as_f64());
        assert!(number(frame, "gamma_max") > 1.0);
    }
    assert!(selected.windows(2).all(|pair| number(&pair[0], "gamma_max") >= number(&pair[1], "gamma_max")));
    assert_eq!((&found["gamma_left"], &found["floor"]), (&0.0.into(), &Json::Null));
    let bytes = fs::read(here.join("out.extxyz")).unwrap();
    let again = select(here, &["pool.extxyz", "--threads", "2", "--memory", "0"]);
    assert_eq!((again, fs::read(here.join("out.extxyz")).unwrap()), (found, bytes));
    // No temporary files remain.
    assert_eq!(fs::read_dir(here).unwrap().count(), 2);
    let first = select(here, &["pool.extxyz", "-n", "1"]);
    assert!(first["gamma_left"].as_f64() > Some(1.0));
}

#[test]
fn several_strategies_pick_from_what_is_left() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    pool(&here.join("pool.extxyz"), 21);
    let parts = ["greedy:2", "fps:2", "fps-all:2", "d-optimal:1", "random-extrap:1", "random:3"];
    let found = select(here, &[&["pool.extxyz", "--strategy"], &parts[..]].concat());
    let of = |strategy: &str| {
        let all = found["strategies"].as_array().unwrap().iter();
        all.filter(|part| part["strategy"] == strategy)
            .map(|part| part["structures"].as_u64().unwrap())
            .sum::<u64>()
    };
    for part in parts {
        let (name, number) = part.split_once(':').unwrap();
        assert_eq!(of(name), number.parse::<u64>().unwrap(), "{name}");
    }
    let selected = read_extxyz(&here.join("out.extxyz")).unwrap();
    let mut numbers: Vec<_> = selected.iter().map(|frame| number(frame, "n") as u64).collect();
    numbers.sort_unstable();
    numbers.dedup();
    assert_eq!(numbers.len(), 11);
    assert_eq!(found["floor"], 131);
    // Commas, repeated options, aliases and a single thread give the same picks.
    let same = [
        "--threads",
        "1",
        "--strategy",
        "greedy:2,fps-extrap:2,fps-all:2,d-optimal:1",
        "--strategy",
        "random-extrap:1",
        "--strategy",
        "random-all:3",
    ];
    assert_eq!(select(here, &[&["pool.extxyz"], &same[..]].concat()), found);
    let other = select(here, &[&["pool.extxyz", "--rng-seed", "1", "--strategy"], &parts[..]].concat());
    assert_ne!(other["picks"], found["picks"]);
    // Atoms above the window are ignored.
    let within = select(here, &["pool.extxyz", "--max-gamma", "1.5", "--min-gamma", "1.1", "-n", "1"]);
    assert!(within["picks"][0]["gamma_max"].as_f64() < Some(1.51));
}

#[test]
fn structures_that_cannot_be_graded_are_left_out() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let frames = pool(&here.join("pool.extxyz"), 8);
    let expected = select(here, &["pool.extxyz"]);
    let (mut foreign, mut near) = (frames[0].clone(), frames[1].clone());
    foreign.structure.species[0] = "Cu".parse().unwrap();
    near.structure.positions[1] = near.structure.positions[0];
    near.structure.positions[1][0] += 0.39;
    let mut broken = frames;
    broken.insert(0, foreign.clone());
    broken.insert(3, near.clone());
    write_frames(&here.join("broken.extxyz"), &broken);
    let (model, artifact) = (file("kokkos.npz"), file("gmm_artifacts.npz"));
    let own = ["select", "--model", &model, "--artifact", &artifact, "--output", "out.extxyz", "--json"];
    let output = calmwalk(here, own.iter().chain(&["broken.extxyz"]));
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    let line = "left out 2 structures that cannot be graded; the first: broken.extxyz:1: atom 0 is Cu";
    assert!(said.contains(line), "{said}");
    let found: Json = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&found["pool"]["ungraded"], &found["pool"]["structures"]), (&2.into(), &8.into()));
    assert_eq!(found["gamma_left"], expected["gamma_left"]);
    // The same picks, each with its place in the file.
    let selected = read_extxyz(&here.join("out.extxyz")).unwrap();
    let picks = expected["picks"].as_array().unwrap();
    assert!(picks.len() > 1 && selected.len() == picks.len());
    for (frame, pick) in selected.iter().zip(picks) {
        let (n, place) = (number(frame, "n"), number(frame, "source_frame") as usize);
        assert_eq!(Some(n as u64), pick["source_frame"].as_u64());
        assert_eq!(frame.structure, broken[place].structure);
    }

    write_frames(&here.join("near.extxyz"), &[near]);
    let message = refused(here, &["near.extxyz", "--output", "x.extxyz"]);
    assert!(
        message.contains("no structure can be graded; near.extxyz:1: atoms 0 and 1 are 0.390 Å"),
        "{message}"
    );
    // A file that cannot be read is an error.
    let text = fs::read_to_string(here.join("pool.extxyz")).unwrap() + "2\n\nAl 0 0 0\n";
    fs::write(here.join("pool.extxyz"), text).unwrap();
    assert!(refused(here, &["pool.extxyz", "--output", "x.extxyz"]).contains("ends after 1 of the 2 atoms"));
    assert!(!here.join("x.extxyz").exists());
}

#[test]
fn wrong_selections_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    pool(&here.join("pool.extxyz"), 2);
    let out = ["--output", "out.extxyz"];
    let cases: [(&[&str], &str); 9] = [
        (
            &["pool.extxyz", "--strategy", "fps"],
            "--strategy fps: expected a number of structures, as in fps:25, or -n",
        ),
        (&["pool.extxyz", "-n", "3", "--strategy", "greedy", "fps:2"], "-n is for a single strategy"),
        (&["pool.extxyz", "--strategy", "gredy"], "unknown strategy 'gredy'"),
        (&["pool.extxyz", "--min-gamma", "2", "--max-gamma", "1"], "--min-gamma 2, --max-gamma 1: expected"),
        (&["pool.extxyz", "--update-target", "0"], "--update-target: found 0, expected"),
        (&["pool.extxyz", "--memory=-1"], "--memory -1: expected a number of GB"),
        (&["pool.cif"], "pool.cif: unknown format"),
        (&["pool.extxyz", "--no-evaluation"], "--campaign"),
        (&[], "<POOL>"),
    ];
    for (arguments, why) in cases {
        let message = refused(here, &[arguments, &out[..]].concat());
        assert!(message.contains(why), "{message}");
    }
    let message = refused(here, &["pool.extxyz", "--output", "pool.extxyz"]);
    assert!(message.contains("is a file of the pool"), "{message}");
    assert!(!here.join("out.extxyz").exists());
    // The mixture of an export has no statistics, so only strategies without updates work.
    let model = file("kokkos.npz");
    let own = ["select", "--model", &model, "pool.extxyz", "--output", "out.extxyz"];
    assert!(refuse(here, own).contains("the mixture has no statistics, which greedy updates"));
    let message = refuse(here, own.iter().chain(&["--strategy", "random:1", "d-optimal:1"]));
    assert!(message.contains("the mixture has no statistics, which d-optimal starts from"), "{message}");
    assert!(
        succeed(here, own.iter().chain(&["--strategy", "fps-all:1"])).contains("selected 1 structure of 2")
    );
}

#[test]
fn candidates_without_stored_features_are_left_out_on_request() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let seed_structures = &["fcc-100", "fcc-097", "fcc-103", "vacancy"];
    let path = Small { walks_per_round: 4, seed_structures, ..Small::default() }.write(here);
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace("max_per_walk", "declined_features_mb = 0\nmax_per_walk")).unwrap();
    succeed(here, ["run", "campaign.toml"]);
    let pool = |more: &[&str]| {
        let common = ["--campaign", "campaign", "--strategy", "random:1", "--no-element-floors"];
        select(here, &[&common[..], more].concat())["pool"].clone()
    };
    let (all, stored, declined) =
        (pool(&[]), pool(&["--no-evaluation"]), pool(&["--no-evaluation", "--declined"]));
    let missing = all["features_computed"].as_u64().unwrap();
    assert!(missing > 0, "{all}");
    assert_eq!(all["candidates_left_out"], 0);
    for (pool, kept) in [(&stored, &all["features_from_stores"]), (&declined, &0.into())] {
        assert_eq!((&pool["structures"], &pool["features_computed"]), (kept, &0.into()));
        assert_eq!(pool["candidates_left_out"], missing);
    }
    let (model, artifact) = (file("kokkos.npz"), file("gmm_artifacts.npz"));
    let own = ["select", "--model", &model, "--artifact", &artifact, "--output", "out.extxyz", "-n", "1"];
    let printed = succeed(here, own.iter().chain(&["--campaign", "campaign", "--no-evaluation"]));
    let plural = if missing == 1 { "" } else { "s" };
    let line = format!("left out {missing} candidate{plural} without stored features of this model\n");
    assert!(printed.contains(&line), "{printed}");
}

#[test]
fn what_was_selected_is_labelled_by_a_campaign() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small { steps: 120, ..Small::default() }.write(here);
    succeed(here, ["run", "campaign.toml"]);
    succeed(here, ["export", "campaign", "--output", "own.extxyz"]);
    // The store has the features of a campaign's candidates.
    let own = select(here, &["--campaign", "campaign", "--strategy", "fps", "-n", "1"]);
    assert!(own["pool"]["features_from_stores"].as_u64() > Some(0), "{own}");
    assert_eq!(own["pool"]["features_computed"], 0);
    let candidate = read_extxyz(&here.join("out.extxyz")).unwrap();
    assert!(candidate[0].info["candidate_id"].text().is_some());
    // Accepted candidates have their labels.
    let accepted = read_extxyz(&here.join("own.extxyz")).unwrap().len();
    let known = format!("queued 0 structures for labelling; {accepted} already known\n");
    assert_eq!(queue(here, "own.extxyz"), known);

    pool(&here.join("pool.extxyz"), 8);
    select(here, &["pool.extxyz", "-n", "2"]);
    assert_eq!(queue(here, "out.extxyz"), "queued 2 structures for labelling; 0 already known\n");
    assert_eq!(queue(here, "out.extxyz"), "queued 0 structures for labelling; 2 already known\n");
    let jobs: Json = serde_json::from_str(&succeed(here, ["queue", "campaign", "list", "--json"])).unwrap();
    let waiting = jobs.as_array().unwrap().iter().filter(|job| job["state"] == "queued");
    let waiting: Vec<_> = waiting.map(|job| (job["candidate"].clone(), job["origin"].clone())).collect();
    let import = |id: &str| (id.into(), "imported".into());
    assert_eq!(waiting, [import("import-1"), import("import-2")]);
    succeed(here, ["queue", "campaign", "prioritise", "import-2", "5"]);
    let status: Json = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
    assert_eq!(status["labels"]["queued"], 2);
    succeed(here, ["store", "check", "campaign"]);

    succeed(here, ["run", "campaign.toml"]);
    assert!(succeed(here, ["explain", "campaign", "import-2"]).contains("import-2"));
    succeed(here, ["export", "campaign", "--output", "again.extxyz"]);
    assert_eq!(fs::read(here.join("own.extxyz")).unwrap(), fs::read(here.join("again.extxyz")).unwrap());
    succeed(here, ["export", "campaign", "--output", "all.extxyz", "--imported"]);
    let (all, selected) = (read_extxyz(&here.join("all.extxyz")), read_extxyz(&here.join("out.extxyz")));
    let (all, selected) = (all.unwrap(), selected.unwrap());
    let imported: Vec<_> =
        all.iter().filter(|frame| frame.info["origin"].text() == Some("imported")).collect();
    assert_eq!(imported.len(), 2);
    for (frame, selected) in imported.into_iter().zip(&selected) {
        assert_eq!(frame.structure, selected.structure);
        assert!(frame.labels().unwrap().forces.is_some());
    }
    succeed(here, ["store", "check", "campaign"]);
}

fn queue(here: &Path, file: &str) -> String {
    succeed(here, ["import", "campaign", file, "--queue"])
}
