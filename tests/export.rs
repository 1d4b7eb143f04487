//! `calmwalk export`: selections, splits by seed structure, and the names of training codes.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use atoms::extxyz::Frame;
use atoms::read_extxyz;
use serde_json::Value;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions, Connection};
use tempfile::TempDir;

use crate::common::campaign::Small;
use crate::common::{calmwalk, deviation, refuse, stderr, succeed};

fn campaign() -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let seed_structures = &["fcc-100", "fcc-097", "fcc-103", "vacancy", "slab-111"];
    let path = Small { seed_structures, ..Small::default() }.write(directory.path());
    succeed(directory.path(), ["run", path.to_str().unwrap(), "--directory", "here"]);
    directory
}

fn export(here: &Path, options: &[&str]) -> Vec<Frame> {
    succeed(here, ["export", "here", "--output", "out.extxyz"].iter().chain(options));
    read_extxyz(&here.join("out.extxyz")).unwrap()
}

fn text<'a>(frame: &'a Frame, key: &str) -> &'a str {
    frame.info[key].text().unwrap()
}

fn largest(frame: &Frame, key: &str) -> f64 {
    frame.arrays[key].reals().unwrap().iter().copied().fold(0.0, f64::max)
}

#[test]
fn some_structures_of_each_walk_are_drawn() {
    let directory = campaign();
    let here = directory.path();
    let of_walks = |frames: &[Frame]| {
        let mut walks: BTreeMap<i64, Vec<String>> = BTreeMap::new();
        for frame in frames {
            let walk = frame.info["walk"].number().unwrap() as i64;
            walks.entry(walk).or_default().push(text(frame, "candidate_id").to_owned());
        }
        walks
    };
    let all = of_walks(&export(here, &["--control"]));
    assert!(all.values().filter(|found| found.len() > 2).count() > 1, "{all:?}");
    let draw = |number: &str, seed: &str| {
        of_walks(&export(here, &["--control", "--per-walk", number, "--draw-rng-seed", seed]))
    };
    let two = draw("2", "0");
    for (walk, drawn) in &two {
        let of_walk = &all[walk];
        assert_eq!(drawn.len(), of_walk.len().min(2));
        let places = drawn.iter().map(|id| of_walk.iter().position(|other| other == id).unwrap());
        assert!(places.is_sorted(), "in the order of the decisions");
    }
    assert_eq!(two.len(), all.len());
    assert_eq!(two, draw("2", "0"));
    assert!((1..5).any(|seed| draw("2", &seed.to_string()) != two), "other random seeds draw others");
    let three = draw("3", "0");
    assert!(two.iter().all(|(walk, drawn)| drawn.iter().all(|id| three[walk].contains(id))));
    assert_eq!(draw("1000", "0"), all);
    // The draw is from what matches the filter.
    let late = "step > 100";
    let matching = of_walks(&export(here, &["--where", late]));
    let printed =
        succeed(here, ["export", "here", "--output", "out.extxyz", "--where", late, "--per-walk", "1"]);
    let drawn = of_walks(&read_extxyz(&here.join("out.extxyz")).unwrap());
    assert_eq!(drawn.keys().collect::<Vec<_>>(), matching.keys().collect::<Vec<_>>());
    for (walk, of_walk) in &matching {
        assert!(drawn[walk].len() == 1 && of_walk.contains(&drawn[walk][0]));
        let plural = if of_walk.len() == 1 { "" } else { "s" };
        let line = format!("drawn: 1 of {} structure{plural} of walk {walk}\n", of_walk.len());
        assert!(printed.contains(&line), "{printed}");
    }
}

/// Connected atoms are one fragment, as is every frame of a dense crystal.
#[test]
fn frames_have_their_number_of_fragments() {
    let directory = campaign();
    let here = directory.path();
    let all = export(here, &[]);
    let number = |frame: &Frame| frame.info["fragments"].number().unwrap();
    for frame in &all {
        assert_eq!(number(frame), atoms::fragments(&frame.structure).unwrap() as f64);
    }
    let one = all.iter().filter(|frame| number(frame) == 1.0).count();
    assert!(one > 0);
    assert_eq!(export(here, &["--where", "fragments = 1"]).len(), one);
    let explained = succeed(here, ["explain", "here", text(&all[0], "candidate_id")]);
    let fragments = number(&all[0]);
    let plural = if fragments == 1.0 { "" } else { "s" };
    assert!(explained.contains(&format!(", {fragments} fragment{plural}; content")), "{explained}");
}

#[test]
fn conditions_choose_what_they_say() {
    let directory = campaign();
    let here = directory.path();
    let all = export(here, &["--control"]);
    let middle = largest(&all[all.len() / 2], "gamma");
    let high = |frame: &Frame| largest(frame, "gamma") > middle;
    let force = |frame: &Frame| {
        let forces = frame.labels().unwrap().forces.unwrap();
        forces.iter().map(|f| atoms::cell::norm(*f)).fold(0.0, f64::max)
    };
    type Choice<'a> = &'a dyn Fn(&Frame) -> bool;
    let choices: [(String, Choice); 5] = [
        (format!("gamma > {middle:?} and element = Al"), &high),
        (format!("not gamma > {middle:?} or origin = control"), &|frame| {
            !high(frame) || text(frame, "origin") == "control"
        }),
        ("seed_structure = 'slab-111' or seed_structure = vacancy".into(), &|frame| {
            ["slab-111", "vacancy"].contains(&text(frame, "seed_structure"))
        }),
        ("max_force >= 1.5 and atoms < 40".into(), &|frame| {
            force(frame) >= 1.5 && frame.structure.len() < 40
        }),
        ("relative_volume <= 1.1 and step > 60".into(), &|frame| {
            frame.info["relative_volume"].number() <= Some(1.1) && frame.info["step"].number() > Some(60.0)
        }),
    ];
    for (condition, meets) in &choices {
        let expected: Vec<_> =
            all.iter().filter(|frame| meets(frame)).map(|frame| text(frame, "candidate_id")).collect();
        assert!((1..all.len()).contains(&expected.len()), "{condition} tells nothing");
        let found = export(here, &["--control", "--where", condition]);
        assert_eq!(
            found.iter().map(|frame| text(frame, "candidate_id")).collect::<Vec<_>>(),
            expected,
            "{condition}"
        );
    }
    for (condition, problem) in [
        ("gamma > 2 elment = Mo", "at character 11: found 'elment', expected 'and', 'or' or the end"),
        ("gamma >", "at character 8: found the end, expected a number"),
        ("element = Mo", "no labelled structure matches --where"),
    ] {
        let message = refuse(here, ["export", "here", "--output", "none.extxyz", "--where", condition]);
        assert!(message.contains(problem), "{message}");
        assert!(!here.join("none.extxyz").exists());
    }
}

#[test]
fn whole_seed_structures_go_to_one_part() {
    let directory = campaign();
    let here = directory.path();
    let all = export(here, &["--control"]);
    let split = |options: &[&str]| {
        let arguments =
            ["export", "here", "--control", "--output", "out.extxyz", "--split", "train=0.6,test=0.4"];
        let printed = succeed(here, arguments.iter().chain(options));
        ["train", "test"].map(|part| {
            let path = here.join(format!("out-{part}.extxyz"));
            let frames = read_extxyz(&path).unwrap();
            let seeds: BTreeSet<_> =
                frames.iter().map(|frame| text(frame, "seed_structure").to_owned()).collect();
            let line =
                format!("{} structures in out-{part}.extxyz, from {} of the", frames.len(), seeds.len());
            assert!(printed.contains(&line), "{printed}");
            (frames, seeds, fs::read(path).unwrap())
        })
    };
    let [(train, train_seeds, bytes), (test, test_seeds, _)] = split(&[]);
    assert!(train_seeds.is_disjoint(&test_seeds), "{train_seeds:?} {test_seeds:?}");
    assert_eq!((train_seeds.len(), test_seeds.len()), (3, 2));
    let mut both = train.clone();
    both.extend(test);
    let order: BTreeMap<_, _> =
        all.iter().enumerate().map(|(k, frame)| (text(frame, "candidate_id"), k)).collect();
    both.sort_by_key(|frame| order[text(frame, "candidate_id")]);
    let ids = |frames: &[Frame]| {
        frames.iter().map(|frame| text(frame, "candidate_id").to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(ids(&both), ids(&all), "every structure is in one part");
    assert!(ids(&train).is_sorted_by_key(|id| order[id.as_str()]), "in the order of the decisions");
    assert!(split(&[])[0].2 == bytes, "the same bytes each time");
    let others: Vec<_> =
        (1..9).map(|seed| split(&["--split-rng-seed", &seed.to_string()])[0].1.clone()).collect();
    assert!(others.iter().any(|other| *other != train_seeds), "another seed gives another split");
    // A selection does not change the part of the other seed structures.
    let [(_, high_seeds, _), _] = split(&["--where", "gamma > 1.5"]);
    assert!(high_seeds.is_subset(&train_seeds));
    let many = "a=0.2,b=0.2,c=0.2,d=0.2,e=0.1,f=0.1";
    let message = refuse(here, ["export", "here", "--output", "out.extxyz", "--split", many]);
    assert!(message.contains("5 seed structures into 6 parts"), "{message}");
    let message = refuse(here, ["export", "here", "--output", "out.extxyz", "--split", "train=0.9,test=0.2"]);
    assert!(message.contains("the shares add up to 1.1"), "{message}");
}

/// ASE reads the labels under the names of each training code, and the origin of each frame.
#[test]
fn training_codes_find_their_names() {
    let directory = campaign();
    let here = directory.path();
    let frames = export(here, &[]);
    let status: Value = serde_json::from_str(&succeed(here, ["status", "here", "--json"])).unwrap();
    for frame in &frames {
        assert_eq!(text(frame, "campaign"), status["campaign"].as_str().unwrap());
    }
    for keys in ["mace", "grace", "gap"] {
        let others = export(here, &["--keys", keys]);
        for (frame, other) in frames.iter().zip(&others) {
            let (labels, read) = (frame.labels().unwrap(), other.labels().unwrap());
            assert_eq!((read.energy, &read.forces), (labels.energy, &labels.forces));
            assert!(deviation(&read.stress.unwrap().concat(), &labels.stress.unwrap().concat()) < 1e-14);
        }
    }
    let Some(python) = std::env::var_os("CALMWALK_PYTHON") else {
        eprintln!("CALMWALK_PYTHON is not set: no comparison with ASE");
        return;
    };
    let names = [
        ("ase", "a.get_potential_energy(), a.get_forces(), a.get_stress(voigt=False)"),
        ("grace", "a.get_potential_energy(force_consistent=True), a.get_forces(), a.get_stress(voigt=False)"),
        ("mace", "a.info['REF_energy'], a.arrays['REF_forces'], a.info['REF_stress']"),
        ("gap", "a.get_potential_energy(), a.arrays['force'], -a.info['virial'] / a.get_volume()"),
    ];
    for (keys, read) in names {
        export(here, &["--keys", keys]);
        let script = format!(
            "import json, sys, ase.io, numpy as np\n\
             f = lambda e, f, s: dict(energy=float(e), forces=np.ravel(f).tolist(), stress=np.ravel(s).tolist())\n\
             print(json.dumps([dict(f({read}), gamma=a.arrays['gamma'].tolist(), campaign=a.info['campaign'],\n\
                 walk=int(a.info['walk']), step=int(a.info['step'])) for a in ase.io.read(sys.argv[1], ':')]))"
        );
        let output =
            Command::new(&python).args(["-c", &script, "out.extxyz"]).current_dir(here).output().unwrap();
        assert!(output.status.success(), "{keys}: {}", stderr(&output));
        let found: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(found.len(), frames.len());
        for (found, frame) in found.iter().zip(&frames) {
            let labels = frame.labels().unwrap();
            let numbers = |key: &str| -> Vec<f64> { serde_json::from_value(found[key].clone()).unwrap() };
            assert_eq!(found["energy"].as_f64(), labels.energy, "{keys}");
            assert_eq!(numbers("forces"), labels.forces.unwrap().as_flattened());
            assert!(deviation(&numbers("stress"), labels.stress.unwrap().as_flattened()) < 1e-12, "{keys}");
            assert_eq!(numbers("gamma"), frame.arrays["gamma"].reals().unwrap());
            assert_eq!(found["campaign"], text(frame, "campaign"));
            assert_eq!(
                (found["walk"].as_f64(), found["step"].as_f64()),
                (frame.info["walk"].number(), frame.info["step"].number())
            );
        }
    }
}

/// Changes the database without the program.
fn change(here: &Path, statements: &[&str]) {
    let file = SqliteConnectOptions::new().filename(here.join("here/campaign.sqlite")).foreign_keys(false);
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let mut connection = file.connect().await.unwrap();
        for sql in statements {
            sqlx::raw_sql(AssertSqlSafe((*sql).to_owned())).execute(&mut connection).await.unwrap();
        }
        connection.close().await.unwrap();
    });
}

/// Standard error of a failed export, which must not write a file.
fn fails(here: &Path) -> String {
    let output = calmwalk(here, ["export", "here", "--output", "out.extxyz"]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let files: Vec<_> = fs::read_dir(here).unwrap().flatten().map(|file| file.file_name()).collect();
    assert!(!files.iter().any(|name| name.to_string_lossy().contains("out.extxyz")), "{files:?}");
    stderr(&output)
}

/// A force has a flipped sign and exponent bit, the index lacks a label, or the table lacks a candidate.
#[test]
fn a_damaged_database_is_refused_with_what_is_damaged() {
    let directory = campaign();
    let here = directory.path();
    let database = here.join("here/campaign.sqlite");
    let whole = fs::read(&database).unwrap();
    change(
        here,
        &[
            "UPDATE label SET forces = CAST(substr(forces, 1, 7) || x'7f' || substr(forces, 9) AS BLOB) WHERE number = 2",
        ],
    );
    let message = fails(here);
    assert!(message.contains("damaged database: label 2: its content has the checksum "), "{message}");
    assert!(message.contains("restore the campaign from a backup"), "{message}");
    let check = calmwalk(here, ["store", "check", "here"]);
    let found = String::from_utf8_lossy(&check.stdout).into_owned();
    assert!(check.status.code() == Some(1) && found.contains("label 2: "), "{found}");

    fs::write(&database, &whole).unwrap();
    change(
        here,
        &[
            "PRAGMA writable_schema = ON; CREATE TABLE kept AS SELECT * FROM sqlite_schema WHERE name = 'label_of'",
            "UPDATE label SET status = 'superseded' WHERE number = 2",
            "DELETE FROM sqlite_schema WHERE name = 'label_of'; PRAGMA writable_schema = RESET",
            "UPDATE label SET status = 'label' WHERE number = 2",
            "PRAGMA writable_schema = ON; INSERT INTO sqlite_schema SELECT * FROM kept; DROP TABLE kept;
             PRAGMA writable_schema = RESET",
        ],
    );
    let message = fails(here);
    assert!(message.contains("label_of") && message.contains("would be missing in an export"), "{message}");

    fs::write(&database, &whole).unwrap();
    change(here, &["DELETE FROM candidate WHERE decision = (SELECT max(decision) FROM candidate)"]);
    let message = fails(here);
    assert!(message.contains("decisions on missing candidates"), "{message}");

    fs::write(&database, &whole).unwrap();
    export(here, &[]);
}

/// Only the owner can read the campaign, its log and its backups.
#[test]
fn files_of_a_campaign_are_private() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = Small { steps: 60, ..Small::default() }.write(here);
    let path = path.to_str().unwrap();
    succeed(here, ["run", path, "--directory", "here", "--log", "run.log"]);
    succeed(here, ["store", "backup", "here", "copy"]);
    // An open database has additional files.
    let open = SqliteConnectOptions::new().filename(here.join("here/campaign.sqlite"));
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let mut connection = open.connect().await.unwrap();
        sqlx::query("SELECT count(*) FROM label").fetch_one(&mut connection).await.unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode(&here.join("run.log")), 0o600);
        for campaign in ["here", "copy"] {
            assert_eq!(mode(&here.join(campaign)), 0o700, "{campaign}");
            for file in fs::read_dir(here.join(campaign)).unwrap().flatten() {
                assert_eq!(mode(&file.path()), 0o600, "{}", file.path().display());
            }
        }
        connection.close().await.unwrap();
    });
}

#[test]
fn a_second_run_is_refused_although_the_lock_is_deleted() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    fs::create_dir(here.join("here")).unwrap();
    let path = Small::default().write(here);
    let lock = store::CampaignLock::acquire(&here.join("here"), "run").unwrap();
    fs::remove_file(here.join("here/campaign.lock")).unwrap();
    let message = refuse(here, ["run", path.to_str().unwrap(), "--directory", "here", "--in-process"]);
    assert!(message.contains("only one process may run a campaign"), "{message}");
    drop(lock);
}
