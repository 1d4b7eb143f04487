//! The report of a campaign with intervals: twelve seed structures, five elements, failed and unfinished labels, labels by value.

use store::{LabelDetails, LabelValue};

use super::*;
use crate::wording;

const ELEMENTS: [&str; 5] = ["Al", "Cu", "Ni", "O", "Si"];
const SEEDS: u32 = 12;
const STEPS: u64 = 3;

/// A number between −1 and 1 for each k.
fn noise(k: u64) -> f64 {
    (1.7 * k as f64 + 0.3 * (k * k % 97) as f64).sin()
}

/// Two atoms of each element in a row.
fn alloy(number: u64) -> Structure {
    let elements = ELEMENTS.iter().cycle().take(2 * ELEMENTS.len());
    let species: Vec<_> = elements.map(|element| element.parse().unwrap()).collect();
    let (atoms, distance) = (species.len(), 2.5 + 0.001 * number as f64);
    Structure {
        species,
        positions: (0..atoms).map(|k| [distance * k as f64, 0.0, 0.0]).collect(),
        cell: Cell::orthorhombic(distance * atoms as f64, 10.0, 10.0),
        periodic: [true; 3],
    }
}

/// A pair of walks for each seed structure, with a pair of structures at each of three steps.
pub async fn begin(directory: &std::path::Path) -> Store {
    let campaign = CampaignRecord {
        id: CAMPAIGN,
        program_version: "0.1.0".into(),
        mode: "live".into(),
        configuration: String::new(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    };
    let seeds: Vec<_> = (0..SEEDS)
        .map(|index| SeedStructure {
            index,
            name: format!("alloy {index}"),
            source: "alloys.extxyz".into(),
            structure: alloy(index.into()),
        })
        .collect();
    let store = Store::create(directory, &campaign, &seeds, 951_827_696_000).await.unwrap();
    let of_seed = |number: u32| WalkRecord {
        seed_structure: number / 2,
        partner: (number % 2 == 1).then(|| WalkId(number - 1)),
        ..walk(number, 0, if number.is_multiple_of(2) { Origin::Biased } else { Origin::Control })
    };
    let walks = (0..2 * SEEDS).map(of_seed).collect();
    store.commit(&Commit { walks, ..Commit::default() }).await.unwrap();
    for step in 1..=STEPS {
        for number in 0..2 * SEEDS {
            find(&store, number, step).await;
        }
    }
    label(&store).await;
    store
}

async fn find(store: &Store, number: u32, step: u64) {
    let (walk, place) = (WalkId(number), u64::from(number) + 100 * step);
    let origin = if number.is_multiple_of(2) { Origin::Biased } else { Origin::Control };
    let structure = alloy(place);
    let content = ContentHash::from_structure(&structure);
    let strength = if origin == Origin::Biased { 1.6 } else { 1.0 };
    let grades: Vec<_> = (0..10).map(|k| strength * (1.0 + 0.7 * noise(place + 31 * k))).collect();
    let id = CandidateId { campaign: CAMPAIGN, walk, segment: 0, step, content };
    let block = CandidateBlock::encode(&Candidate {
        id,
        origin,
        mixture_version: 0,
        temperature: 600.0 * strength,
        relative_volume: 1.0 + 0.1 * step as f64,
        energy: -1.0,
        virial: [[0.0; 3]; 3],
        structure,
        forces: vec![[0.0; 3]; 10],
        gamma: grades.clone(),
        gamma_nbr: grades.clone(),
        features: (0..30).map(|k| noise(place * 7 + k)).collect(),
    });
    let original = AtomGrades { gamma: grades.clone(), gamma_nbr: grades };
    let record = CandidateRecord {
        block,
        fate: Fate::Accepted,
        seed_structure: number / 2,
        selector: original.clone(),
        original,
        keep_features: true,
        priority: 0,
    };
    let decision = Decision {
        round: 1,
        kind: if origin == Origin::Biased { "accepted" } else { "control" },
        walk: Some(walk),
        candidate: Some(id),
        mixture_version: step,
        detail: json!({}),
    };
    let commit = Commit { decisions: vec![decision], candidates: vec![record], ..Commit::default() };
    store.commit(&commit).await.unwrap();
}

/// 24 of the 72 structures are labelled by value, three of the others fail, and two wait.
async fn label(store: &Store) {
    let protocol =
        Protocol { hash: ContentHash([3; 32]), name: "dft".into(), settings: json!({ "code": "dft" }) };
    store.add_protocol(&protocol, 0).await.unwrap();
    let jobs = store.queue_list(None, 99, 0).await.unwrap();
    let value = |job: i64| LabelValue { job, value: 1.0, factors: json!({}) };
    let values: Vec<_> = jobs.iter().step_by(3).map(|job| value(job.job)).collect();
    store.set_label_values(&values).await.unwrap();
    for number in 0..70_u64 {
        let lease = store.lease(protocol.hash, "a", 0, 1000).await.unwrap().unwrap();
        if [30, 41, 52].contains(&number) {
            store.fail(&lease, "not_converged", "", 1, 500).await.unwrap();
            continue;
        }
        let error = |k: u64| 0.4 * (1.0 + 0.9 * noise(number * 13 + 5 * k)) * (1.0 + noise(number)).max(0.2);
        let forces = (0..10).map(|k| [error(k), 0.5 * error(k + 3), 0.0]).collect();
        let pressure = 0.002 * (1.0 + noise(number + 9));
        let stress = Some([[pressure, 0.0, 0.0], [0.0, pressure, 0.0], [0.0, 0.0, pressure]]);
        let label = Label {
            energy: -1.0 + 0.2 * noise(number + 5),
            forces,
            stress,
            details: LabelDetails::default(),
        };
        store.complete(&lease, &label, 500).await.unwrap();
    }
}

/// The cells of the rows of a table that begin like this.
fn rows<'a>(files: &'a [PageFile], table: &str, start: &str) -> Vec<Vec<&'a str>> {
    let lines = file(files, &format!("tables/{table}.csv")).lines().filter(|line| line.starts_with(start));
    lines.map(|line| line.split(',').collect()).collect()
}

fn interval(cell: &str) -> (f64, f64) {
    let (low, high) = cell.split_once(" to ").unwrap_or_else(|| panic!("no interval: '{cell}'"));
    (low.parse().unwrap(), high.parse().unwrap())
}

#[tokio::test]
async fn a_campaign_with_enough_of_everything_has_intervals_everywhere() {
    let directory = tempfile::tempdir().unwrap();
    let store = begin(directory.path()).await;
    let files = build(&store, None).await.unwrap();
    are_on_the_page(&files);
    for svg in files.iter().filter(|file| file.path.ends_with(".svg")) {
        words(std::str::from_utf8(&svg.bytes).unwrap());
    }
    let page = words(file(&files, PAGE)).replace('\u{a0}', " ");
    for expected in [
        "by bootstrap over 12 seed structures (1000 draws)",
        "The queue chose 24 of all 67 structures by value",
        "2 label jobs are unfinished",
        "of labels chosen by value, n = ",
    ] {
        assert!(page.contains(expected), "{expected}: {page}");
    }

    // Every median of every group has an interval that holds it, and that of the force MAE a range for the failed labels.
    for group in ["matched biased", "matched control", "pooled all", "pooled biased", "pooled control"] {
        let of = rows(&files, "comparison-errors", group);
        let names: Vec<_> = of.iter().map(|row| row[1]).collect();
        let expected =
            ["force MAE (eV/Å)", "energy error (meV/atom)", "stress error (GPa)", "|ΔF| of atoms (eV/Å)"];
        assert_eq!(names, expected, "{group}");
        for row in &of {
            let (value, (low, high)) = (row[2].parse::<f64>().unwrap(), interval(row[3]));
            assert!(low < value && value < high, "{row:?}");
        }
        assert_eq!(of[0][4].contains(" to "), of[1][4].is_empty(), "{group}");
        let ranks = rows(&files, "comparison-ranks", group);
        assert!(ranks.len() == 2 && ranks.iter().all(|row| interval(row[4]).0 < interval(row[4]).1));
    }
    for row in rows(&files, "pairs", "").iter().skip(1) {
        assert!(interval(row[4]).0 < interval(row[4]).1, "{row:?}");
    }
    // Of five elements in three groups.
    let elements = rows(&files, "elements", "");
    assert_eq!(elements.len(), 1 + 3 * ELEMENTS.len());
    assert!(elements.iter().skip(1).all(|row| interval(row[4]).0 < interval(row[4]).1), "{elements:?}");
    let ranges = rows(&files, "pair-counts", "median of the ");
    let has = |start: &str| ranges.iter().any(|row| row[0].starts_with(start) && row[1].contains(" to "));
    assert!(has("median of the biased side between: stress error"), "{ranges:?}");

    // Both calibrations have bounds, of which one is in use in each bin.
    let bounds = ["error-bounds", "error-bounds-by-value"].map(|table| rows(&files, table, ""));
    for of in &bounds {
        let known = of.iter().skip(1).filter(|row| row[1] == "all" && !row[3].is_empty()).count();
        assert!(known > 1 && of.iter().any(|row| row[1] == "Ni"), "{of:?}");
    }
    let in_use = |of: &[Vec<&str>]| {
        let all = of.iter().filter(|row| row[1] == "all" && row[8] == "yes");
        all.map(|row| row[0].to_owned()).collect::<Vec<_>>()
    };
    let [found, by_value] = bounds.each_ref().map(|of| in_use(of));
    assert!(!found.is_empty() && found.iter().all(|bin| !by_value.contains(bin)), "{found:?} {by_value:?}");
}

/// The dashboard has the same of the same labels.
#[tokio::test]
async fn the_page_of_errors_has_what_the_report_has() {
    let directory = tempfile::tempdir().unwrap();
    let store = begin(directory.path()).await;
    let statistics = monitor::label_statistics::read(&store, ContentHash([3; 32]), None).await.unwrap();
    let protocol = store.protocol_in_force().await.unwrap().unwrap();
    let json = wording::json::force_errors_for_page(&statistics, &protocol);
    let compared = &json["biased_against_control"];
    let notes: Vec<_> =
        compared["notes"].as_array().unwrap().iter().map(|note| note.as_str().unwrap()).collect();
    for expected in ["the queue chose 24 of 67 structures by value", "2 label jobs unfinished"] {
        assert!(notes.iter().any(|note| note.starts_with(expected)), "{notes:?}");
    }
    for error in compared["shown"]["errors"].as_array().unwrap() {
        let pairs = &compared["pairs"][error["key"].as_str().unwrap()];
        assert!(
            pairs["biased"]["interval"].is_array() && pairs["biased_between"].is_array(),
            "{error} {pairs}"
        );
        if let Some(key) = error["group_key"].as_str() {
            assert!(compared["pooled"]["all"][key]["interval"].is_array(), "{key}");
        }
    }
    let calibration = monitor::calibration::read(&store, protocol.hash, 0).await.unwrap().summary();
    let bounds = wording::json::error_bounds(&calibration);
    assert!(
        bounds["note"].as_str().unwrap().contains("90 % of force errors are below"),
        "{}",
        bounds["note"]
    );
}
