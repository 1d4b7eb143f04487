//! What the dashboard shows of structures and of the potential's errors: the map of feature space, values beside those of labels,
//! columns and orders of the table, and files of a selection.

use std::collections::BTreeMap;
use std::io::BufReader;
use std::path::Path;
use std::process::Stdio;

use atoms::extxyz::{ExtxyzReader, Frame};
use serde_json::Value;
use tempfile::TempDir;

use crate::common::campaign::Small;
use crate::common::http::{get, get_computed, said};
use crate::common::{Running, program, succeed};

/// The dashboard of a finished campaign.
struct Shown {
    directory: TempDir,
    address: String,
    _server: Running,
}

impl Shown {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        Small::default().write(directory.path());
        succeed(directory.path(), ["run", "campaign.toml"]);
        let mut command = program(directory.path());
        command.args(["dashboard", "campaign", "--address", "127.0.0.1:0"]);
        let mut server = Running(command.stderr(Stdio::piped()).spawn().unwrap());
        let [address] = said(&mut server.0, ["dashboard at http://"]);
        Self { address: address.trim_end_matches('/').to_owned(), directory, _server: server }
    }

    fn here(&self) -> &Path {
        self.directory.path()
    }

    /// The rows of the table, by one request.
    fn rows(&self, query: &str) -> Vec<Value> {
        let page = get(&self.address, &format!("/api/candidates?limit=200&{query}"));
        assert_eq!(page.status, 200, "{page:?}");
        let page = page.json();
        let errors = page["errors"].as_array().unwrap().clone();
        let rows = page["candidates"].as_array().unwrap().iter().zip(errors);
        let with_errors = |(row, errors): (&Value, Value)| {
            let mut row = row.clone();
            row["errors"] = errors;
            row
        };
        rows.map(with_errors).collect()
    }

    fn frames(&self, query: &str) -> Vec<Frame> {
        let file = get(&self.address, &format!("/api/candidates.extxyz?{query}"));
        assert!(file.status == 200 && file.head.contains("filename=\"candidates.extxyz\""), "{}", file.head);
        read(file.body.as_bytes())
    }

    /// Checks that a request is refused as wrong, with these words.
    fn refuses(&self, path: &str, status: u16, words: &str) {
        let answer = get(&self.address, path);
        let why = answer.json()["error"].as_str().unwrap_or_default().to_owned();
        assert!(answer.status == status && why.contains(words), "{path}: {} {why}", answer.status);
    }
}

fn read(bytes: &[u8]) -> Vec<Frame> {
    ExtxyzReader::new(BufReader::new(bytes)).map(|frame| frame.unwrap()).collect()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

#[test]
fn the_dashboard_shows_the_chemistry() {
    let shown = Shown::new();
    check_map(&shown);
    check_errors(&shown);
    check_orders(&shown);
    check_files(&shown);
}

/// Every collected structure is on the map, with the grade that the table has.
fn check_map(shown: &Shown) {
    let map = get_computed(&shown.address, "/api/map");
    let [accepted, control] = ["accepted", "control"].map(|fate| shown.rows(&format!("fate={fate}")));
    for (part, rows) in [("accepted", &accepted), ("control", &control)] {
        let expected = (Some(rows.len() as u64), Some(rows.len() as u64));
        assert_eq!((map[part]["all"].as_u64(), map[part]["shown"].as_u64()), expected, "{part}");
    }
    let by_id: BTreeMap<_, _> =
        accepted.iter().chain(&control).map(|row| (row["id"].as_str().unwrap(), row)).collect();
    let [plane] = &map["planes"].as_array().unwrap()[..] else { panic!("one element") };
    assert_eq!((&plane["element"], &map["mixture_missing"]), (&"Al".into(), &Value::Null));
    let points = plane["points"].as_array().unwrap();
    assert_eq!(points.len(), by_id.len());
    for point in points {
        let structure = &map["structures"][point["structure"].as_u64().unwrap() as usize];
        let row = by_id[structure["id"].as_str().unwrap()];
        assert!((number(&point["gamma"]) - number(&row["gamma"])).abs() < 1e-4, "{point} {row}");
        assert_eq!((&structure["walk"], &structure["origin"]), (&row["walk"], &row["origin"]));
        let error = number(&row["errors"]["max_force_error"]);
        assert!((number(&point["force_error"]) - error).abs() < 1e-4, "{point} {row}");
    }
    // The components of the artifact, with the variance that the axes have.
    let components = plane["components"].as_array().unwrap();
    let artifact = crate::common::config("data/al_eam_1l/gmm_artifacts.npz").display().to_string();
    let artifact: Value =
        serde_json::from_str(&succeed(shown.here(), ["calm", "info", &artifact, "--json"])).unwrap();
    let counts = |of: &Value, key: &str| -> Vec<f64> {
        of.as_array().unwrap().iter().map(|component| number(&component[key])).collect()
    };
    assert_eq!(counts(&plane["components"], "environments"), counts(&artifact["components"], "count"));
    assert!(components.iter().all(|one| number(&one["covariance"][0]) > 0.0));
    let shares = [number(&plane["shares"][0]), number(&plane["shares"][1])];
    assert!(shares[0] >= shares[1] && shares[1] > 0.0 && shares[0] + shares[1] <= 1.0 + 1e-12, "{shares:?}");
    shown.refuses("/api/map?element=Al", 400, "no parameters");
}

/// The errors of single structures, and their means, agree with `calmwalk force-errors`.
fn check_errors(shown: &Shown) {
    let page = get_computed(&shown.address, "/api/errors");
    let parity = &page["parity"];
    let printed = succeed(shown.here(), ["force-errors", "campaign", "--json"]);
    let printed: Value = serde_json::from_str(&printed).unwrap();
    assert_eq!(printed.get("parity"), None, "it is for the page");
    let near = |a: &Value, b: &Value| (number(a) - number(b)).abs() < 1e-9;
    assert!(near(&parity["energy"]["mae"], &printed["energy"]["mean"]), "{}", parity["energy"]["mae"]);
    assert_eq!(parity["energy"]["number"], printed["energy"]["structures"]);
    for quantity in ["energy", "force", "stress"] {
        let of = &parity[quantity];
        assert!(number(&of["rmse"]) >= number(&of["mae"]) && number(&of["mae"]) > 0.0, "{quantity}");
        for point in of["points"].as_array().unwrap() {
            assert!(number(&point["label"]).is_finite() && number(&point["model"]).is_finite());
        }
    }
    let rows = shown.rows("state=labelled");
    assert!(rows.len() > 4);
    let biased = rows.iter().filter(|row| row["origin"] == "biased");
    for row in biased {
        let ours = parity["energy"]["points"].as_array().unwrap();
        let Some(point) = ours.iter().find(|point| point["id"] == row["id"]) else { continue };
        let error = number(&point["model"]) - number(&point["label"]);
        assert!((error - number(&row["errors"]["energy"])).abs() < 1e-9, "{row}");
        let per_atom = number(&row["potential_energy"]) / number(&row["atoms"]);
        assert!((per_atom - number(&point["model"])).abs() < 1e-9, "{row}");
        let explained =
            get(&shown.address, &format!("/api/candidates/{}", row["id"].as_str().unwrap())).json();
        let model = &explained["labels"][0]["model"];
        assert!(near(&model["largest"], &row["errors"]["max_force_error"]), "{model} {row}");
    }
}

/// Any column sorts, page by page, and says among how many.
fn check_orders(shown: &Shown) {
    let all = shown.rows("");
    for (order, pointer) in [
        ("atoms", "/atoms"),
        ("temperature", "/temperature"),
        ("gamma_current", "/selector_gamma"),
        ("force_mae", "/errors/force_mae"),
        ("stress_error", "/errors/stress"),
        ("max_force", "/max_force"),
    ] {
        let value = |row: &Value| row.pointer(pointer).and_then(Value::as_f64);
        let expected = all.iter().filter(|row| value(row).is_some()).count();
        assert!(expected > 3, "{order}");
        for (ascending, sign) in [("true", 1.0), ("false", -1.0)] {
            let (mut found, mut after) = (Vec::new(), String::new());
            loop {
                let path = format!("/api/candidates?limit=3&order={order}&ascending={ascending}{after}");
                let page = get(&shown.address, &path).json();
                assert_eq!(page["sorted_among"], serde_json::json!({ "number": expected, "all": true }));
                let rows =
                    page["candidates"].as_array().unwrap().iter().zip(page["errors"].as_array().unwrap());
                found.extend(rows.map(|(row, errors)| {
                    let mut row = row.clone();
                    row["errors"] = errors.clone();
                    (sign * value(&row).unwrap(), row["id"].as_str().unwrap().to_owned())
                }));
                let Some(next) = page["next"].as_str() else { break };
                after = format!("&after={next}");
            }
            assert!(found.is_sorted_by(|a, b| a.0 <= b.0), "{order}: {found:?}");
            let names: std::collections::BTreeSet<_> = found.iter().map(|(_, id)| id).collect();
            assert_eq!((found.len(), names.len()), (expected, expected), "{order}");
        }
    }
    let texts: Vec<_> = shown
        .rows("order=fate&ascending=true")
        .iter()
        .map(|row| {
            if row["origin"] == "control" {
                "control".to_owned()
            } else {
                row["fate"].as_str().unwrap().to_owned()
            }
        })
        .collect();
    assert!(texts.len() == all.len() && texts.is_sorted(), "{texts:?}");
    let hot = shown.rows("order=temperature&fate=accepted&where=gamma+%3E+1");
    assert!(
        hot.iter()
            .all(|row| row["fate"] == "accepted" && row["origin"] == "biased" && number(&row["gamma"]) > 1.0)
    );
    shown.refuses("/api/candidates?order=size", 400, "expected one of decision");
    shown.refuses("/api/candidates?order=atoms&after=1.5:2:3", 400, "of another order");
}

/// The file of a selection has the frames of `calmwalk export`.
fn check_files(shown: &Shown) {
    let condition = "max_force > 0 and gamma > 1";
    succeed(
        shown.here(),
        ["export", "campaign", "--output", "set.extxyz", "--control", "--where", condition],
    );
    let exported = read(&std::fs::read(shown.here().join("set.extxyz")).unwrap());
    let query: String = form_urlencoded::byte_serialize(condition.as_bytes()).collect();
    let found = shown.frames(&format!("where={query}&ascending=true"));
    assert!(found.len() > 2, "{}", found.len());
    assert!(found == exported, "the same frames in the same order");
    for (query, status, words) in [
        ("limit=5", 400, "do not apply"),
        ("where=gama+%3E+1", 400, "gamma_nbr"),
        ("where=gamma+%3E+1e9", 404, "no candidate matches"),
        ("shape=round", 400, "unknown parameter 'shape'"),
    ] {
        shown.refuses(&format!("/api/candidates.extxyz?{query}"), status, words);
    }
}
