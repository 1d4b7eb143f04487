//! `calmwalk explain`: the history of every candidate agrees with the store.

use std::fs;
use std::path::Path;

use atoms::cell::{norm, sub};
use serde_json::Value;
use store::{LoggedDecision, Store, StoredCandidate};
use tempfile::TempDir;

use crate::common;
use crate::common::campaign::Small;
use crate::common::{refuse, succeed};

/// Concurrent walks from similar structures: a structure found by one of them is often covered for the others.
fn campaign(changes: &[(&str, &str)]) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let small = Small {
        walks_per_round: 4,
        seed_structures: &["fcc-100", "fcc-097", "fcc-103", "vacancy"],
        ..Small::default()
    };
    let path = small.write(directory.path());
    let mut text = fs::read_to_string(&path).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "no {from}");
        text = text.replacen(from, to, 1);
    }
    fs::write(path, text).unwrap();
    succeed(directory.path(), ["run", "campaign.toml", "--directory", "here"]);
    directory
}

fn explain(here: &Path, id: &str) -> Value {
    serde_json::from_str(&succeed(here, ["explain", "here", id, "--json"])).unwrap()
}

/// All decisions of the campaign with their candidates.
fn contents(here: &Path) -> Vec<(LoggedDecision, Option<StoredCandidate>)> {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let store = Store::open_read_only(here.join("here")).await.unwrap();
        let mut contents = Vec::new();
        for decision in store.decisions(1..=100_000).await.unwrap() {
            let candidate = match &decision.candidate {
                Some(name) => store.candidate(name).await.unwrap(),
                None => None,
            };
            contents.push((decision, candidate));
        }
        store.close().await;
        contents
    })
}

/// Candidate names in a list.
fn names(list: &Value) -> Vec<&str> {
    list.as_array().unwrap().iter().map(|named| named["candidate"].as_str().unwrap()).collect()
}

/// Compares the grades with the store; the triggering atoms are those above the threshold.
fn check_grades(details: &Value, stored: &StoredCandidate) {
    let (view, grades) = (stored.block.view(), &details["grades"]);
    let atoms = grades["atoms"].as_array().unwrap();
    assert_eq!(atoms.len(), view.gamma.len());
    for (k, atom) in atoms.iter().enumerate() {
        assert_eq!((&atom["atom"], &atom["element"]), (&k.into(), &"Al".into()));
        assert_eq!(atom["gamma_walker"], view.gamma[k]);
        assert_eq!(atom["gamma_nbr_walker"], view.gamma_nbr[k]);
        assert_eq!(atom["gamma_selector"], stored.selector.gamma[k]);
        assert_eq!(atom["gamma_original"], stored.original.gamma[k]);
        assert_eq!(atom["gamma_nbr_original"], stored.original.gamma_nbr[k]);
        let biased = details["origin"] == "biased";
        assert_eq!(atom["triggered"], biased && view.gamma[k] > 1.0);
    }
    assert_eq!(grades["walker"]["mixture_version"], view.mixture_version());
    let largest = stored.original.gamma.iter().copied().fold(0.0, f64::max);
    assert_eq!(grades["original"]["gamma_max"], largest);
}

/// Checks the label, and the errors of the potential's forces.
fn check_label(details: &Value, stored: &StoredCandidate) {
    let labels = details["labels"].as_array().unwrap();
    assert_eq!((labels.len(), &labels[0]["status"]), (1, &"label".into()));
    assert_eq!(details["jobs"][0]["state"], "labelled");
    assert_eq!(details["jobs"][0]["attempts_made"][0]["outcome"], "labelled");
    let model = &labels[0]["model"];
    let errors: Vec<f64> = serde_json::from_value(model["atoms"].clone()).unwrap();
    let largest = errors.iter().copied().fold(0.0, f64::max);
    assert_eq!(
        (model["largest"].as_f64(), errors[model["atom"].as_u64().unwrap() as usize]),
        (Some(largest), largest)
    );
    let energy = labels[0]["energy"].as_f64().unwrap();
    let difference = (stored.block.view().energy() - energy) / errors.len() as f64;
    assert!((model["energy_per_atom"].as_f64().unwrap() - difference).abs() < 1e-12);
}

#[test]
fn every_candidate_has_its_history() {
    let directory = campaign(&[]);
    let here = directory.path();
    let contents = contents(here);
    let mut kinds = std::collections::BTreeSet::new();
    for (decision, stored) in
        contents.iter().filter_map(|(decision, stored)| Some((decision, stored.as_ref()?)))
    {
        kinds.insert(decision.kind.clone());
        let name = decision.candidate.as_deref().unwrap();
        let details = explain(here, name);
        assert_eq!((&details["format"], &details["id"]), (&1.into(), &name.into()));
        assert_eq!(details, explain(here, &decision.sequence.to_string()), "by the decision's number");
        check_grades(&details, stored);
        let decided = &details["decision"];
        assert_eq!(
            (&decided["number"], &decided["kind"], &decided["mixture_version"]),
            (&decision.sequence.into(), &decision.kind.clone().into(), &decision.mixture_version.into())
        );
        let (trials, logged) = (&decided["update"]["trials"], &decision.detail["update"]["trials"]);
        assert_eq!(trials, logged);
        if let Some(components) = decided["update"]["components"].as_array() {
            let symbols = vec![Value::from("Al"); components.len()];
            assert_eq!(decided["update"]["component_elements"], Value::from(symbols));
            assert!(decided["update"]["covariance_update"].is_string(), "{decided}");
            let text = succeed(here, ["explain", "here", name]);
            assert!(text.contains("components changed: component 0 of Al"), "{text}");
        }
        match decision.kind.as_str() {
            "accepted" => check_accepted(&details, decision, stored, &contents),
            "declined" => check_declined(&details, decision, stored, &contents),
            _ => {
                check_label(&details, stored);
                let text = succeed(here, ["explain", "here", name]);
                assert!(text.contains("a control walk: unbiased") && !text.contains("its guard"), "{text}");
                let partner = details["found"]["partner"]["candidate"].as_str().unwrap();
                let place =
                    format!("-{}.0.{}-", details["found"]["control_of"], stored.block.view().id().step);
                assert!(partner.contains(&place), "{partner} {place}");
            }
        }
    }
    assert_eq!(kinds.into_iter().collect::<Vec<_>>(), ["accepted", "control", "declined"]);
}

fn check_accepted(
    details: &Value,
    decision: &LoggedDecision,
    stored: &StoredCandidate,
    contents: &[(LoggedDecision, Option<StoredCandidate>)],
) {
    check_label(details, stored);
    let trigger = &details["grades"]["trigger"];
    assert!(trigger["above_walker"].as_u64() >= trigger["needed"].as_u64(), "{trigger}");
    // Candidates declined as covered after this decision, whose walker had not seen this mixture version, from the whole log.
    let later = contents.iter().filter(|(later, candidate)| {
        let seen = candidate.as_ref().map(|candidate| candidate.block.view().mixture_version());
        later.sequence > decision.sequence
            && later.detail["reason"] == "covered"
            && seen.is_some_and(|seen| seen < decision.mixture_version)
    });
    let later: Vec<_> = later.map(|(later, _)| later.candidate.as_deref().unwrap()).collect();
    assert_eq!(names(&details["decision"]["coverage"]["later"]), later);
}

fn check_declined(
    details: &Value,
    decision: &LoggedDecision,
    stored: &StoredCandidate,
    contents: &[(LoggedDecision, Option<StoredCandidate>)],
) {
    assert_eq!(details["decision"]["reason"], decision.detail["reason"]);
    assert_eq!(
        (&details["jobs"], &details["labels"]),
        (&Value::Array(Vec::new()), &Value::Array(Vec::new()))
    );
    if decision.detail["reason"] == "covered" {
        let seen = stored.block.view().mixture_version();
        let earlier = contents.iter().filter(|(earlier, _)| {
            earlier.sequence < decision.sequence
                && earlier.kind == "accepted"
                && earlier.mixture_version > seen
        });
        let mut by: Vec<_> = earlier.map(|(earlier, _)| earlier.candidate.as_deref().unwrap()).collect();
        by.reverse();
        assert!(!by.is_empty());
        assert_eq!(names(&details["decision"]["coverage"]["by"]), by);
    }
}

#[test]
fn explain_describes_copies_and_failed_labels_in_words() {
    let directory = campaign(&[("[label]\n", "[label]\nmax_force = 1e-6\nmax_attempts = 1\n")]);
    let here = directory.path();
    let contents = contents(here);
    let of_kind = |kind: &str| {
        let found = contents.iter().find(|(decision, _)| decision.kind == kind).unwrap();
        found.0.candidate.clone().unwrap()
    };
    let accepted = of_kind("accepted");
    succeed(here, ["queue", "here", "drop", &accepted]);
    succeed(here, ["queue", "here", "retry", &accepted]);
    succeed(here, ["queue", "here", "prioritise", &accepted, "77"]);
    fs::create_dir(here.join("copy")).unwrap();
    fs::copy(here.join("here/campaign.sqlite"), here.join("copy/campaign.sqlite")).unwrap();
    let before = fs::read(here.join("copy/campaign.sqlite")).unwrap();
    // The id may omit the campaign and the content hash.
    let short = accepted.split('-').nth(1).unwrap();
    for place in ["here", "copy"] {
        let told = succeed(here, ["explain", place, short]);
        for part in [
            accepted.as_str(),
            "atom_count: at least",
            "α = 0.05 applied",
            "queued, priority 77",
            "by the user: prioritise, to 77",
            "by the user: drop",
            "bypasses the labellers' guard",
            "attempt 1: failed (",
            "not recorded",
        ] {
            assert!(told.contains(part), "no '{part}' in\n{told}");
        }
    }
    assert_eq!(
        fs::read(here.join("copy/campaign.sqlite")).unwrap(),
        before,
        "explain does not change the copy"
    );
    let actions = &explain(here, &accepted)["jobs"][0]["manual_actions"];
    assert_eq!(actions.as_array().map(Vec::len), Some(3), "{actions}");
    let declined = succeed(here, ["explain", "here", &of_kind("declined")]);
    assert!(declined.contains("declined: ") && declined.contains("no label job"), "{declined}");
    let control = succeed(here, ["explain", "here", &of_kind("control")]);
    assert!(
        control.contains("random numbers of walk") && control.contains("at least the selector's limit"),
        "{control}"
    );
}

#[test]
fn imported_structures_have_theirs_and_what_is_not_there_is_refused() {
    let directory = campaign(&[]);
    let here = directory.path();
    succeed(here, ["export", "here", "--output", "labelled.extxyz"]);
    let frames = atoms::read_extxyz(&here.join("labelled.extxyz")).unwrap();
    let mut moved = frames[0].clone();
    moved.structure.positions[0][0] += 0.01;
    common::write_frames(&here.join("moved.extxyz"), &[moved, frames[0].clone()]);
    succeed(here, ["import", "here", "moved.extxyz"]);
    let details = explain(here, "import-1");
    assert_eq!(
        (&details["origin"], &details["frame"], &details["decision"]),
        (&"imported".into(), &0.into(), &Value::Null)
    );
    assert_eq!(details["labels"][0]["energy"].as_f64(), frames[0].labels().unwrap().energy);
    let forces = frames[0].labels().unwrap().forces.unwrap();
    let largest = forces.iter().map(|force| norm(sub(*force, [0.0; 3]))).fold(0.0, f64::max);
    assert_eq!(details["labels"][0]["max_force"].as_f64(), Some(largest));
    let known = explain(here, "import-2");
    assert_eq!(known["same_structure"][0]["candidate"].as_str(), frames[0].info["candidate_id"].text());

    let first = contents(here).into_iter().find(|(decision, _)| decision.candidate.is_some()).unwrap().0;
    for wrong in ["1", "99.0.1", "nonsense", "-1"] {
        let message = refuse(here, ["explain", "here", "--", wrong]);
        assert!(message.contains(&format!("no candidate matches '{wrong}'")), "{message}");
        assert!(message.contains(&format!("{} to ", first.sequence)), "{message}");
        assert!(message.contains(first.candidate.as_deref().unwrap()), "{message}");
    }
    for wrong in ["import-0", "import-3", "import-x"] {
        let message = refuse(here, ["explain", "here", wrong]);
        assert!(message.contains("they are import-1 to import-2"), "{message}");
    }
}
