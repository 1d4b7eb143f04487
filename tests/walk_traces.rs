//! Traces of walks in every view of a campaign.

use std::fs;
use std::path::Path;
use std::process::Stdio;

use serde_json::Value;
use tempfile::TempDir;

use crate::common::campaign::Small;
use crate::common::http::{get, said};
use crate::common::{Running, program, refuse, succeed};

fn campaign(changes: &[(&str, &str)]) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let path = Small::default().write(directory.path());
    let mut text = fs::read_to_string(&path).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "no {from}");
        text = text.replacen(from, to, 1);
    }
    fs::write(path, text).unwrap();
    succeed(directory.path(), ["run", "campaign.toml", "--directory", "here"]);
    directory
}

/// The CSV of a walk: titles, and rows of numbers.
fn csv(here: &Path, walk: u64) -> (Vec<String>, Vec<Vec<Option<f64>>>) {
    let text = succeed(here, ["walks", "here", "trace", &walk.to_string()]);
    let mut lines = text.lines();
    let titles = lines.next().unwrap().split(',').map(str::to_owned).collect();
    let number = |cell: &str| (!cell.is_empty()).then(|| cell.parse().unwrap());
    (titles, lines.map(|line| line.split(',').map(number).collect()).collect())
}

fn walks(here: &Path) -> Vec<Value> {
    let status: Value = serde_json::from_str(&succeed(here, ["status", "here", "--json"])).unwrap();
    status["walks"].as_array().unwrap().clone()
}

/// What a walk of 20 unbiased and up to 240 biased steps, with a ramp from 1 to 1.25, must have.
fn check_points(walk: &Value, titles: &[String], rows: &[Vec<Option<f64>>]) {
    let column =
        |name: &str| titles.iter().position(|title| title == name).unwrap_or_else(|| panic!("no {name}"));
    let is_biased = walk["origin"] == "biased";
    assert!(rows.len() > 3, "{walk}");
    for (number, row) in rows.iter().enumerate() {
        let of = |name: &str| row[column(name)];
        let step = of("step").unwrap();
        assert_eq!((of("number"), step), (Some(number as f64), 10.0 * number as f64), "{walk}");
        assert_eq!((of("segment"), of("time")), (Some(0.0), Some(2.0 * step)));
        let volume = 1.0 + 0.25 * (step - 20.0).max(0.0) / 240.0;
        assert!((of("relative_volume").unwrap() - volume).abs() < 1e-12, "{row:?}");
        let lengths = of("a").unwrap() * of("b").unwrap() * of("c").unwrap();
        let first = ["a", "b", "c"].iter().map(|name| rows[0][column(name)].unwrap()).product::<f64>();
        assert!((lengths / first - volume).abs() < 1e-9 && of("alpha") == Some(90.0), "{row:?}");
        assert!(of("temperature").unwrap() > 100.0 && of("pressure").unwrap().abs() < 100.0, "{row:?}");
        assert_eq!(of("conserved_energy"), None, "there is none with a Langevin thermostat");
        assert!(of("gamma_max").unwrap() > 0.0 && of("gamma_max_original").unwrap() > 0.0);
        let is_first = number == 0 && walk["walk"] == 0;
        assert!(!is_first || of("gamma_max") == of("gamma_max_original"), "{row:?}");
        let acts = is_biased && step > 30.0;
        assert_eq!((of("bias_scale") > Some(0.0), of("bias_share") > Some(0.0)), (acts, acts), "{row:?}");
        // τ is 0.3 on average over the steps, not at each of them.
        assert!(!acts || (0.1..0.9).contains(&of("bias_share").unwrap()), "{row:?}");
        assert_eq!(of("bias_work") != Some(0.0), acts, "{row:?}");
    }
    let last = walk["step"].as_f64().unwrap();
    assert_eq!(rows.len(), 1 + (last / 10.0) as usize, "{walk}");
}

#[test]
fn every_view_shows_the_points_of_the_walks() {
    let directory = campaign(&[("tau = 0.3\n", "tau = 0.3\ntrace_interval = 10\n")]);
    let here = directory.path();
    let walks = walks(here);
    assert!(walks.iter().any(|walk| walk["origin"] == "control"));
    let mut command = program(here);
    command.args(["dashboard", "here", "--address", "127.0.0.1:0"]);
    let mut shown = Running(command.stderr(Stdio::piped()).spawn().unwrap());
    let [address] = said(&mut shown.0, ["dashboard at http://"]);
    let address = address.trim_end_matches('/');
    for walk in &walks {
        let number = walk["walk"].as_u64().unwrap();
        let (titles, rows) = csv(here, number);
        check_points(walk, &titles, &rows);
        let json = get(address, &format!("/api/walks/{number}/trace")).json();
        assert_eq!(
            (&json["walk"], &json["origin"], &json["threshold"]),
            (&walk["walk"], &walk["origin"], &1.0.into())
        );
        let points = json["points"].as_array().unwrap();
        assert_eq!(points.len(), rows.len());
        for (point, row) in points.iter().zip(&rows) {
            for (title, cell) in titles.iter().zip(row) {
                let edge = ["a", "b", "c", "alpha", "beta", "gamma"].iter().position(|edge| edge == title);
                let found = edge.map_or(&point[title], |edge| &point["cell"][edge]);
                assert_eq!(found.as_f64(), *cell, "{title} {point}");
            }
        }
    }
    assert_eq!(get(address, "/api/walks/99/trace").status, 404);
    check_explanations(here, address);

    succeed(here, ["walks", "here", "trace", "1", "--output", "walk.csv"]);
    let written = fs::read_to_string(here.join("walk.csv")).unwrap();
    assert_eq!(written, succeed(here, ["walks", "here", "trace", "1"]));
    let unknown = refuse(here, ["walks", "here", "trace", "99"]);
    assert!(unknown.contains("the campaign has no walk 99; they are 0 to 3"), "{unknown}");

    succeed(here, ["report", "here", "--output", "report"]);
    let figure = fs::read_to_string(here.join("report/figures/walks.csv")).unwrap();
    let biased = walks.iter().filter(|walk| walk["origin"] == "biased");
    let points: usize = biased.map(|walk| csv(here, walk["walk"].as_u64().unwrap()).1.len()).sum();
    assert_eq!(figure.lines().count(), 1 + points);
    let page = fs::read_to_string(here.join("report/report.html")).unwrap();
    assert!(
        page.contains("id=\"figure-walks\"") && page.contains("Biased walks (n = 2)"),
        "no figure of walks"
    );
}

/// Every candidate names the last point before it.
fn check_explanations(here: &Path, address: &str) {
    let page = get(address, "/api/candidates?limit=100").json();
    let candidates = page["candidates"].as_array().unwrap();
    assert!(candidates.len() > 4);
    for candidate in candidates {
        let id = candidate["id"].as_str().unwrap();
        let details: Value = serde_json::from_str(&succeed(here, ["explain", "here", id, "--json"])).unwrap();
        let (found, step) = (&details["found"]["trace_point"], candidate["step"].as_u64().unwrap());
        assert_eq!(found["step"], step - step % 10, "{candidate}");
        let text = succeed(here, ["explain", "here", id]);
        assert!(text.contains(&format!("trace at step {}: ", step - step % 10)), "{text}");
    }
}

/// The selector grades candidates with mixtures of its own.
#[test]
fn the_points_at_candidates_have_their_grades() {
    let directory = campaign(&[("tau = 0.3\n", "tau = 0.3\ntrace_interval = 1\n")]);
    let here = directory.path();
    let listed = succeed(here, ["export", "here", "--control", "--output", "all.extxyz"]);
    let frames = atoms::read_extxyz(&here.join("all.extxyz")).unwrap();
    assert!(frames.len() > 4, "{listed}");
    let mut updated = 0;
    for frame in frames {
        let id = frame.info["candidate_id"].text().unwrap();
        let details: Value = serde_json::from_str(&succeed(here, ["explain", "here", id, "--json"])).unwrap();
        let point = &details["found"]["trace_point"];
        assert_eq!(point["step"], details["found"]["step"]);
        updated += u32::from(point["gamma_max"] != point["gamma_max_original"]);
        for (key, mixture) in [("gamma_max_original", "original"), ("gamma_max", "walker")] {
            let numbers = [&point[key], &details["grades"][mixture]["gamma_max"]];
            let [found, expected] = numbers.map(|number| number.as_f64().unwrap());
            assert!((found / expected - 1.0).abs() < 1e-9, "{key} of {id}: {found}, not {expected}");
        }
    }
    assert!(updated > 0, "no candidate after an update");
}

#[test]
fn a_campaign_without_an_interval_has_no_traces() {
    let directory = campaign(&[("tau = 0.3\n", "tau = 0.3\ntrace_interval = 0\n")]);
    let here = directory.path();
    let (titles, rows) = csv(here, 0);
    assert_eq!((titles.len(), rows.len()), (20, 0));
    succeed(here, ["report", "here", "--output", "report"]);
    assert!(!here.join("report/figures/walks.csv").exists());
}
