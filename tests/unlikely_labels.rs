//! Walks that avoid what cannot be labelled, in a whole campaign.

use std::fs;
use std::path::Path;

use serde_json::Value as Json;
use store::{LoggedDecision, Store};

use crate::common::campaign::Small;
use crate::common::label_campaign::WRITE_FIXED_LABEL;
use crate::common::succeed;

/// Fails as the paper's labeller did, with the probability 1 / (1 + exp(−k (V/V₀ − v₀))) of `orchestrator/tests/completion.rs`. The
/// positions decide, so that a structure always has the same fate. V₀ is that of the seed structure, (8.1 Å)³.
const SCRIPT: &str = r#"
awk -v k=23.62036107 -v v0=1.34202187 '
    NR == 2 { split($0, part, "\""); split(part[2], cell, " "); v = cell[1] * cell[5] * cell[9] / 531.441 }
    NR > 2 { sum += $2 + 1.7 * $3 + 2.3 * $4 }
    END { u = 1000 * sum; u = u - int(u); if (u < 0) u += 1; exit u < 1 / (1 + exp(k * (v - v0))) ? 0 : 1 }
' structure.extxyz || exit 3
"#;

/// The probability of the script.
fn probability(relative_volume: f64) -> f64 {
    1.0 / (1.0 + (23.620_361_07 * (relative_volume - 1.342_021_87)).exp())
}

/// A live campaign of four walks in one crystal, which expand to 1.4 V₀ and collect a structure every ten steps. Walks wait for labels, so
/// that the model keeps up with them.
fn configuration(directory: &Path) -> String {
    let small = Small {
        mode: "live",
        walkers: 1,
        steps: 400,
        max_per_walk: 100,
        seed_structures: &["fcc-100"],
        ..Small::default()
    };
    small.write(directory);
    let mut text = small.text();
    for (from, to) in [
        ("rng_seed = 7\n", "rng_seed = 7\ncontrol = false\n"),
        ("[calm]\n", "[calm]\nupdate = \"never\"\n"),
        ("to = 1.25 }\n", "to = 1.4 }\n[[walks]]\nname = \"all\"\nrepeats = 4\n"),
        ("threshold = 1.0, fraction = 0.1 }", "threshold = 0.2, fraction = 0.03 }"),
        (
            "min_interval = 30\nmin_interval_after_decline = 5\n",
            "min_interval = 10\nmin_interval_after_decline = 10\nmin_completion_probability = 0.9\n",
        ),
        (
            "[label]\nmethod",
            "[label]\nmax_attempts = 1\nqueue_limit = 1\nconcurrency = 2\nmethod = { command = { command = [\"sh\", \"label.sh\"], files = [\"label.sh\"], version = \"1\" } } #",
        ),
        ("steps_per_assignment = 40", "steps_per_assignment = 10"),
    ] {
        assert!(text.contains(from), "no {from}");
        text = text.replacen(from, to, 1);
    }
    text
}

/// Decisions on candidates, with V/V₀ of each, and the share of the labels of accepted ones that completed.
struct Decided {
    rows: Vec<(LoggedDecision, f64)>,
}

impl Decided {
    async fn read(directory: &Path) -> Self {
        let store = Store::open_read_only(directory).await.unwrap();
        let mut rows = Vec::new();
        for decision in store.decisions(1..=i64::MAX).await.unwrap() {
            let Some(name) = decision.candidate.as_deref() else { continue };
            let found = store.candidate(name).await.unwrap().unwrap();
            let volume = found.block.view().relative_volume();
            rows.push((decision, volume));
        }
        Self { rows }
    }
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (number, sum) = values.fold((0.0, 0.0), |(number, sum), value| (number + 1.0, sum + value));
    sum / number
}

#[test]
fn walks_avoid_what_cannot_be_labelled() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    fs::write(here.join("campaign.toml"), configuration(here)).unwrap();
    fs::write(here.join("label.sh"), SCRIPT.to_owned() + WRITE_FIXED_LABEL).unwrap();
    let summary = succeed(here, ["run", "campaign.toml"]);
    let status: Json = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
    let declined = status["candidates"]["declined"]["unlikely_to_complete"].as_u64().unwrap();
    assert!(declined > 10 && summary.contains(&format!("{declined} unlikely to complete")), "{summary}");
    succeed(here, ["report", "campaign", "-o", "report"]);
    let collection = fs::read_to_string(here.join("report/figures/collection.csv")).unwrap();
    assert!(collection.contains(&format!("a,unlikely to complete,{declined},")), "{collection}");
    let model = fs::read_to_string(here.join("report/tables/completion-model.csv")).unwrap();
    assert!(model.contains("V/V₀"), "{model}");

    let runtime = tokio::runtime::Runtime::new().unwrap();
    let Decided { rows } = runtime.block_on(Decided::read(&here.join("campaign")));
    let is_declined = |decision: &LoggedDecision| decision.detail["reason"] == "unlikely_to_complete";
    assert_eq!(rows.iter().filter(|(decision, _)| is_declined(decision)).count() as u64, declined);
    for (decision, _) in rows.iter().filter(|(decision, _)| is_declined(decision)) {
        let completion = &decision.detail["completion"];
        assert!(completion["probability"].as_f64() < Some(0.9), "{completion}");
        assert_eq!(completion["min_probability"], 0.9);
    }
    // From the first decline on: of what walks offered, and of what was collected, the mean probability to complete.
    let first = rows.iter().position(|(decision, _)| is_declined(decision)).unwrap();
    let (offered, collected) = (
        mean(rows[first..].iter().map(|(_, volume)| probability(*volume))),
        mean(rows[first..].iter().filter(|(of, _)| !is_declined(of)).map(|(_, volume)| probability(*volume))),
    );
    assert!(offered < 0.88 && collected >= 0.92, "{offered} {collected} from {first} of {}", rows.len());
    // The labels agree: nearly all that failed came before.
    let [labelled, failed] =
        ["labelled", "failed"].map(|state| status["labels"][state].as_u64().unwrap() as f64);
    let share = labelled / (labelled + failed);
    assert!(share > mean(rows.iter().map(|(_, volume)| probability(*volume))) + 0.03, "{share}");
}
