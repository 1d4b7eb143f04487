mod many_elements;

use atoms::{Cell, Structure};
use quick_xml::Reader;
use quick_xml::events::Event;
use serde_json::json;
use store::{
    AtomGrades, CampaignRecord, CandidateRecord, Commit, Decision, Fate, Label, Protocol, SeedStructure,
    Store, VersionRecord, VersionState, WalkRecord,
};
use wire::messages::{DeclineReason, WalkProgress};
use wire::{
    CampaignId, Candidate, CandidateBlock, CandidateId, ContentHash, Origin, TracePoint, WalkConditions,
    WalkId,
};

use super::*;
use crate::wording::comparison;

const CAMPAIGN: CampaignId = CampaignId([7; 16]);
const ATOMS: usize = 8;
const DIMENSION: usize = 3;

/// A row of atoms, `distance` Å apart, in a long cell.
fn structure(distance: f64) -> Structure {
    Structure {
        species: vec!["Al".parse().unwrap(); ATOMS],
        positions: (0..ATOMS).map(|k| [distance * k as f64, 0.0, 0.0]).collect(),
        cell: Cell::orthorhombic(distance * ATOMS as f64, 10.0, 10.0),
        periodic: [true; 3],
    }
}

async fn begin(directory: &std::path::Path, configuration: &str) -> Store {
    let campaign = CampaignRecord {
        id: CAMPAIGN,
        program_version: "0.1.0".into(),
        mode: "reproducible".into(),
        configuration: String::new(),
        resolved_configuration: configuration.into(),
        configuration_in_force: configuration.into(),
    };
    let (name, source) = ("a<b>&\"row\"".into(), "rows.extxyz".into());
    let seed = SeedStructure { index: 0, name, source, structure: structure(2.5) };
    Store::create(directory, &campaign, &[seed], 951_827_696_000).await.unwrap()
}

async fn offer(store: &Store, step: u64, origin: Origin, fate: Fate, keep_features: bool) {
    // The structure of a control walk differs slightly from that of its biased walk.
    let shift = if origin == Origin::Control { 0.001 } else { 0.0 };
    let structure = structure(2.5 + 0.01 * step as f64 + shift);
    let content = ContentHash::from_structure(&structure);
    // The grades increase from atom to atom.
    let grades: Vec<_> = (0..ATOMS).map(|k| 0.2 * (k + 1) as f64).collect();
    let walk = WalkId(u32::from(origin == Origin::Control));
    let id = CandidateId { campaign: CAMPAIGN, walk, segment: 0, step, content };
    let features = (0..DIMENSION * ATOMS).map(|k| (0.7 * (step + 1) as f64 * k as f64).sin()).collect();
    let block = CandidateBlock::encode(&Candidate {
        id,
        origin,
        mixture_version: 0,
        temperature: 300.0,
        relative_volume: 1.0 + 0.01 * step as f64,
        energy: -1.0,
        virial: [[0.0; 3]; 3],
        structure,
        forces: vec![[0.0; 3]; ATOMS],
        gamma: grades.clone(),
        gamma_nbr: grades.clone(),
        features,
    });
    let original = AtomGrades { gamma: grades.clone(), gamma_nbr: grades };
    let selector = original.clone();
    let record =
        CandidateRecord { block, fate, seed_structure: 0, selector, original, keep_features, priority: 0 };
    let kind = match (origin, fate) {
        (Origin::Control, _) => "control",
        (_, Fate::Accepted) => "accepted",
        _ => "declined",
    };
    let (walk, candidate) = (Some(walk), Some(id));
    let decision = Decision { round: 1, kind, walk, candidate, mixture_version: step, detail: json!({}) };
    store
        .commit(&Commit { decisions: vec![decision], candidates: vec![record], ..Commit::default() })
        .await
        .unwrap();
}

async fn label_all(store: &Store) {
    let settings = json!({ "code": "dft" });
    let protocol = Protocol { hash: ContentHash([3; 32]), name: "dft".into(), settings };
    store.add_protocol(&protocol, 0).await.unwrap();
    while let Some(lease) = store.lease(protocol.hash, "a", 0, 1000).await.unwrap() {
        // The error of an atom is half its grade.
        let forces = (0..ATOMS).map(|k| [0.1 * (k + 1) as f64, 0.0, 0.0]).collect();
        let label = Label { energy: -1.0, forces, stress: None, details: Default::default() };
        store.complete(&lease, &label, 500).await.unwrap();
    }
}

/// Checks that a text is XML, and returns its words.
fn words(text: &str) -> String {
    let mut reader = Reader::from_str(text);
    let (mut words, mut open) = (String::new(), 0);
    loop {
        match reader.read_event().unwrap_or_else(|error| panic!("{error}: {text:.300}")) {
            Event::Start(start) => {
                start.attributes().for_each(|attribute| drop(attribute.expect("an attribute")));
                open += 1;
            }
            Event::End(_) => open -= 1,
            Event::Text(text) => words += &text,
            Event::GeneralRef(name) => words += &format!("&{};", &*name),
            Event::Eof => break,
            _ => {}
        }
    }
    assert_eq!(open, 0);
    words
}

fn file<'a>(files: &'a [PageFile], path: &str) -> &'a str {
    let file = files.iter().find(|file| file.path == path);
    std::str::from_utf8(&file.unwrap_or_else(|| panic!("no {path}")).bytes).unwrap()
}

/// Checks that every table is on the page, in the order of their numbers.
fn are_on_the_page(files: &[PageFile]) {
    let page = file(files, PAGE);
    let mut places = Vec::new();
    for table in files.iter().filter_map(|file| file.path.strip_prefix("tables/")?.strip_suffix(".csv")) {
        let place = page.find(&format!("<table id=\"table-{table}\">"));
        places.push(place.unwrap_or_else(|| panic!("{table} is not on the page")));
    }
    assert!(places.len() > 3 && places.is_sorted(), "{places:?}");
}

#[tokio::test]
async fn every_setting_is_on_the_page() {
    let directory = tempfile::tempdir().unwrap();
    // More keys than the page shows of a growing table, and one that is last in the alphabet.
    let keys: serde_json::Map<_, _> = (0..80).map(|k| (format!("key{k:02}"), json!(k))).collect();
    let configuration = json!({ "guard": keys, "walk": { "temperature": 417.0, "volume_ramp": null } });
    let store = begin(directory.path(), &configuration.to_string()).await;
    let files = build(&store, None).await.unwrap();
    let page = words(file(&files, PAGE));
    for expected in ["[guard]", "key79", "[walk]", "temperature", "417.0", "volume_ramp", "not set"] {
        assert!(page.contains(expected), "{expected}: {page}");
    }
    let csv = file(&files, "tables/settings.csv");
    assert!(
        csv.starts_with("key,value\nwalk.temperature,417.0\nwalk.volume_ramp,\nguard.key00,0\n"),
        "{csv}"
    );
}

#[tokio::test]
async fn missing_data_are_reported() {
    let directory = tempfile::tempdir().unwrap();
    let store = begin(directory.path(), "{}").await;
    let files = build(&store, None).await.unwrap();
    assert!(!files.iter().any(|file| file.path.starts_with("figures/")), "nothing to draw");
    let page = words(file(&files, PAGE));
    for expected in [
        "not shown. No structure has been collected yet.",
        "No candidate has reached",
        "&lt;b&gt;",
        "2000-02-29 12:34 UTC",
    ] {
        assert!(page.contains(expected), "{expected}: {page}");
    }

    // Structures without labels, controls or features.
    for step in 0..30 {
        offer(&store, step, Origin::Biased, Fate::Accepted, false).await;
    }
    offer(&store, 99, Origin::Biased, Fate::Declined(DeclineReason::Covered), false).await;
    let files = build(&store, None).await.unwrap();
    let page = words(file(&files, PAGE));
    for expected in ["no force error is known", "The store has no features", "n = 31", "240 atoms"] {
        assert!(page.replace('\u{a0}', "").contains(expected), "{expected}: {page}");
    }
    let drawn: Vec<_> =
        files.iter().filter(|file| file.path.ends_with(".svg")).map(|f| f.path.as_str()).collect();
    assert_eq!(drawn, ["figures/collection.svg", "figures/distributions.svg", "figures/space.svg"]);
    assert!(!file(&files, "figures/space.csv").contains("control"));
}

#[tokio::test]
async fn figures_have_the_numbers_of_the_store() {
    let directory = tempfile::tempdir().unwrap();
    let store = begin(directory.path(), &json!({ "walk": { "tau": 0.5 } }).to_string()).await;
    for step in 0..40 {
        offer(&store, step, Origin::Biased, Fate::Accepted, true).await;
        offer(&store, step, Origin::Control, Fate::Accepted, true).await;
        offer(&store, 1000 + step, Origin::Biased, Fate::Declined(DeclineReason::Duplicate), true).await;
    }
    label_all(&store).await;
    let files = build(&store, None).await.unwrap();
    assert_eq!(files.iter().filter(|file| file.path.ends_with(".png")).count(), 10);
    for svg in files.iter().filter(|file| file.path.ends_with(".svg")) {
        words(std::str::from_utf8(&svg.bytes).unwrap());
    }
    let page = file(&files, PAGE);
    words(page);
    are_on_the_page(&files);
    assert!(
        !page.contains("http://") || page.matches("http://").count() == 10,
        "only names of SVG's elements"
    );
    assert!(!page.contains("https://") && page.contains("[walk]") && page.contains("tau"));

    // Errors of 0.1 to 0.8 eV/Å along x: 3.6 / 24 and √(2.04 / 24).
    let said = words(page).replace('\u{a0}', "");
    for expected in ["force: MAE 0.1500, RMSE 0.2915 eV/Å over 1920 components", "stress: none known"] {
        assert!(said.contains(expected), "{expected}: {said}");
    }
    let parity = file(&files, "figures/parity.csv");
    assert!(parity.lines().filter(|row| row.starts_with("b,control,")).count() == 960, "{parity:.300}");

    // Eight atoms of each of 80 structures. The grades 1.2, 1.4 and 1.6 have half of that as error.
    let correlations = file(&files, "tables/correlations.csv");
    let all: Vec<_> = correlations.lines().nth(1).unwrap().split(',').collect();
    assert_eq!((all[1], all[2], all[6]), ("80", "640", "1"), "{correlations}");
    assert!((all[3].parse::<f64>().unwrap() - 0.45).abs() < 1e-12 && all[4] == "37.5");
    // The only grade between 1.5 and 2 is 1.6, and its errors are all the same.
    let bounds = file(&files, "tables/error-bounds.csv");
    let row =
        bounds.lines().find(|row| row.starts_with("1.5–2,all,50,")).unwrap_or_else(|| panic!("{bounds}"));
    let numbers: Vec<f64> = row.split(',').skip(3).filter_map(|cell| cell.parse().ok()).collect();
    assert!((numbers[0] - 0.8).abs() < 1e-9 && (numbers[1] - 0.8).abs() < 1e-9, "{row}");
    assert_eq!(numbers[3], 60.0, "the first 20 have no bound: {row}");
    assert!(file(&files, "figures/error-bounds.csv").contains("\nb,,,60,"));
    let bands = file(&files, "figures/errors.csv");
    let mut atoms = 0;
    for row in bands.lines().skip(1).filter(|row| row.starts_with("a,biased")) {
        let cells: Vec<_> = row.split(',').map(|cell| cell.parse::<f64>().unwrap_or(f64::NAN)).collect();
        atoms += cells[4] as u64;
        let is_inside =
            2.0 * cells[7] >= cells[2] * (1.0 - 1e-9) && 2.0 * cells[7] <= cells[3] * (1.0 + 1e-9);
        assert!(cells[4] == 0.0 || is_inside, "{row}");
    }
    assert_eq!(atoms, 320);
    // The cell is stretched with the atoms, evenly: one distance a structure, 1 to 1.156.
    let stretched: u64 = bands
        .lines()
        .filter(|row| row.starts_with("b,control"))
        .map(|row| row.split(',').nth(4).unwrap().parse::<u64>().unwrap())
        .sum();
    assert_eq!(stretched, 320);
    let collection = file(&files, "figures/collection.csv");
    assert!(collection.contains("a,duplicate,40,\n") && collection.ends_with("b,,80,40\n"), "{collection}");
    let features = file(&files, "figures/features.csv");
    let rows = |start: &str| features.lines().filter(|row| row.starts_with(start)).count();
    assert_eq!((rows("Al,biased,atom"), rows("Al,control,centroid")), (320, 40));
    assert!(rows("Al,biased,contour,0") > 20);
    let seeds = file(&files, "tables/seed-structures.csv");
    assert!(seeds.contains("\"a<b>&\"\"row\"\"\",Al8,0,,80,40,0,40,0,0,0,40,80,0"), "{seeds}");

    let again = build(&store, None).await.unwrap();
    assert!(files.iter().zip(&again).all(|(a, b)| a.path == b.path && a.bytes == b.bytes), "the same bytes");
}

#[tokio::test]
async fn biased_walks_are_compared_with_their_controls() {
    let directory = tempfile::tempdir().unwrap();
    let store = begin(directory.path(), "{}").await;
    let control = WalkRecord { partner: Some(WalkId(0)), ..walk(1, 0, Origin::Control) };
    let walks = vec![walk(0, 0, Origin::Biased), control];
    store.commit(&Commit { walks, ..Commit::default() }).await.unwrap();
    for step in 0..30 {
        offer(&store, step, Origin::Biased, Fate::Accepted, false).await;
        if step < 20 {
            offer(&store, step, Origin::Control, Fate::Accepted, false).await;
        }
    }
    label_all(&store).await;
    let files = build(&store, None).await.unwrap();
    let page = words(file(&files, PAGE));
    for expected in ["no intervals: 1 seed structure and 1 biased walk are too few", "n = 20 pairs"] {
        assert!(page.replace('\u{a0}', " ").contains(expected), "{expected}: {page}");
    }
    // The errors are 0.1 to 0.8 along x: their mean is 0.45, that of the components a third.
    let pairs = file(&files, "tables/pairs.csv");
    let row: Vec<_> = pairs.lines().nth(1).unwrap().split(',').collect();
    assert_eq!((row[0], row[1], row[2], row[4]), ("force MAE (eV/Å)", "biased", "20", ""), "{pairs}");
    assert!((row[3].parse::<f64>().unwrap() - 0.15).abs() < 1e-12, "{pairs}");
    // Both sides have the same errors: nothing to test.
    assert!(file(&files, "tables/pair-tests.csv").contains("force MAE (eV/Å),0 of 0,,,0 of 0,,"));
    assert!(
        file(&files, "tables/pair-counts.csv")
            .contains("biased structures without a labelled or failed partner,10\n")
    );
    let groups = file(&files, "tables/comparison.csv");
    assert!(
        groups.contains("matched control,20,0,1,1,300,") && groups.contains("pooled biased,30,0,1,1,300,")
    );
    let points = file(&files, "figures/pairs.csv");
    assert_eq!(points.lines().filter(|line| line.starts_with("a,")).count(), 20);
    assert!(
        points.contains("a,0,0,19,,") && points.contains("\na median,") && points.contains("\nb,,,,0.1,")
    );
    words(file(&files, "figures/pairs.svg"));
    names_are_those_of_the_json(&store).await;
    assert!(!files.iter().any(|file| file.path == "tables/elements.csv"), "there is one element");
}

/// The dashboard finds errors and groups in the JSON of the comparison by the keys that come with their names.
async fn names_are_those_of_the_json(store: &Store) {
    let statistics = monitor::label_statistics::read(store, ContentHash([3; 32]), None).await.unwrap();
    let compared = statistics.comparison();
    let (json, shown) = (json!(compared), comparison::shown());
    let groups = comparison::groups(&compared);
    let is_named = |name: &str| groups.iter().find(|(of, _)| *of == name).map(|(_, group)| json!(group));
    for group in shown["groups"].as_array().unwrap() {
        let [kind, walks] = [0, 1].map(|k| group["place"][k].as_str().unwrap());
        assert_eq!(is_named(group["name"].as_str().unwrap()).unwrap(), json[kind][walks]);
    }
    let errors = comparison::known_errors(&compared.pairs);
    assert_eq!(errors.len(), 3, "there is no stress");
    for (error, quantity) in errors {
        assert_eq!(json!(quantity), json["pairs"][error.key]);
    }
    assert_eq!(shown["errors"][0]["key"], "force_mae");
}

/// A walk with this number and version of the potential.
fn walk(number: u32, version: u32, origin: Origin) -> WalkRecord {
    WalkRecord {
        walk: WalkId(number),
        origin,
        partner: None,
        seed_structure: 0,
        conditions: WalkConditions { version, ..WalkConditions::default() },
        state: "completed".into(),
        reason: String::new(),
        assignments: 0,
        accepted: 9,
        progress: WalkProgress::default(),
        selector_state: "{}".into(),
        checkpoint: None,
    }
}

/// Walks of 200 steps with a point after every 50, at a temperature of 300 K plus their number.
async fn traced(store: &Store, number: u32) {
    let progress = WalkProgress { step: 200, ..WalkProgress::default() };
    let record = |number| WalkRecord { progress: progress.clone(), ..walk(number, 0, Origin::Biased) };
    let point = |walk: u32, number: u64| TracePoint {
        number,
        step: 50 * number,
        time: 100.0 * number as f64,
        temperature: 300.0 + f64::from(walk),
        gamma_max: Some(1.0),
        ..TracePoint::default()
    };
    let traces = (0..number).map(|walk| (WalkId(walk), (0..5).map(|number| point(walk, number)).collect()));
    let (walks, traces) = ((0..number).map(record).collect(), traces.collect());
    store.commit(&Commit { walks, traces, ..Commit::default() }).await.unwrap();
}

#[tokio::test]
async fn walks_have_a_line_each_until_they_are_many() {
    let rule = json!({ "collect": { "criterion": { "rule": "maximum_grade", "threshold": 1.5 } } });
    for (number, titles, row, rows) in [
        (3, "walk,segment,step,temperature,", "\n2,0,50,302,", 15),
        (9, "quantity,step,walks,smallest,median,largest\n", "\ntemperature,1.005,9,300,304,308\n", 35),
    ] {
        let directory = tempfile::tempdir().unwrap();
        let store = begin(directory.path(), &rule.to_string()).await;
        traced(&store, number).await;
        let files = build(&store, None).await.unwrap();
        let csv = file(&files, "figures/walks.csv");
        assert!(csv.starts_with(titles) && csv.contains(row), "{csv}");
        assert_eq!(csv.lines().count(), 1 + rows, "{csv}");
        let (page, drawn) = (words(file(&files, PAGE)), words(file(&files, "figures/walks.svg")));
        assert!(page.contains(&format!("(n = {number})")) && page.contains("the threshold 1.5"), "{page}");
        assert!(drawn.contains("step of 2 fs") && !drawn.contains("pressure"), "{drawn}");
        assert_eq!(drawn.contains("walk 2"), number == 3, "{drawn}");
    }
}

fn refused_version() -> VersionRecord {
    let errors =
        |force_mae: f64| json!({ "energy_mae": 0.01, "force_mae": force_mae, "force_rmse": 2.0 * force_mae });
    let set = |name: &str, version: f64| json!({ "name": name, "kind": "test", "structures": 5, "parent": errors(0.2), "version": errors(version) });
    VersionRecord {
        number: 1,
        parent: 0,
        state: VersionState::Refused,
        reason: "its errors rose".into(),
        method: "native".into(),
        structures: 30,
        last_decision: 30,
        labels: 25,
        model_hash: String::new(),
        mixture_hash: String::new(),
        figures: json!({ "sets": [set("liquid", 0.1), set("surface", 0.3)] }),
        seconds: 60.0,
        core_hours: 0.5,
        time: 1,
    }
}

#[tokio::test]
async fn versions_are_shown_apart_from_each_other() {
    let directory = tempfile::tempdir().unwrap();
    let store = begin(directory.path(), "{}").await;
    let walks = vec![walk(0, 0, Origin::Biased), walk(1, 2, Origin::Control)];
    store.commit(&Commit { walks, ..Commit::default() }).await.unwrap();
    for step in 0..30 {
        offer(&store, step, Origin::Biased, Fate::Accepted, true).await;
        offer(&store, step, Origin::Control, Fate::Accepted, true).await;
    }
    label_all(&store).await;
    store.add_version(&refused_version(), None).await.unwrap();
    let files = build(&store, None).await.unwrap();
    let page = words(file(&files, PAGE));
    for expected in
        ["Versions of the potential", "Only from walks with version 2 of the potential", "its errors rose"]
    {
        assert!(page.contains(expected), "{expected}: {page}");
    }
    are_on_the_page(&files);
    let features = file(&files, "figures/features.csv");
    assert!(features.contains("Al,control") && !features.contains("Al,biased"), "{features}");
    let correlations = file(&files, "tables/correlations.csv");
    assert!(correlations.contains("all,30,240,"), "{correlations}");
    let groups = file(&files, "tables/comparison.csv");
    assert!(groups.contains("pooled control,30,0,") && !groups.contains("pooled biased"), "{groups}");
    let grades = file(&files, "tables/version-grades.csv");
    let rows: Vec<_> = grades.lines().skip(1).map(|row| row.split(',').take(3).collect::<Vec<_>>()).collect();
    assert_eq!(rows, [["0", "30", "240"], ["2", "30", "240"]]);
    let errors = file(&files, "tables/version-errors.csv");
    let rows: Vec<Vec<_>> = errors.lines().skip(1).map(|row| row.split(',').collect()).collect();
    assert_eq!((rows.len(), rows[0][0], rows[0][4]), (4, "0", "0.2"), "{errors}");
    assert_eq!((rows[3][0], rows[3][1], rows[3][4]), ("1 (refused)", "surface", "0.3"), "{errors}");
    let curves = file(&files, "figures/errors-by-cost.csv");
    assert!(curves.contains("liquid,test,0,in_force,0,5,0.2\n"), "{curves}");
    file(&files, "figures/errors-by-labels.svg");

    let files = build(&store, Some(0)).await.unwrap();
    let groups = file(&files, "tables/comparison.csv");
    assert!(groups.contains("pooled biased,30,0,") && !groups.contains("control"), "{groups}");
}
