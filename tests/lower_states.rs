//! `calmwalk lower-states`: labels made with changed moments are marked, and the lower of two magnetic states is proposed or
//! becomes the label.

use std::fs;
use std::path::Path;

use serde_json::{Value as Json, json};

use crate::common::campaign::Small;
use crate::common::label_campaign::LabelCampaign;
use crate::common::{refuse, succeed};

/// Converges to −2.5 eV after the moments were changed; without a change only if the file `converges` exists, to the energy
/// in it.
const SCRIPT: &str = r#"
case "$CALMWALK_RETRY_ADJUSTMENTS" in
    *other_moments*) energy=-2.5 ;;
    *) energy=$(cat "HERE/converges") || exit 3 ;;
esac
awk -v energy="$energy" '
    NR == 1 { print; next }
    NR == 2 { sub(/Properties=[^ ]*/, "Properties=species:S:1:pos:R:3:forces:R:3"); print $0 " energy=" energy; next }
    { print $0, 0.25, 0, 0 }
' structure.extxyz > unfinished
mv unfinished label.extxyz
"#;

/// A finished campaign whose labels all needed changed moments.
fn campaign() -> LabelCampaign {
    let small =
        Small { walkers: 1, steps: 120, seed_structures: &["fcc-100"], max_per_walk: 2, ..Small::default() };
    let command = r#"{ command = { command = ["sh", "label.sh"], files = ["label.sh"], version = "1" } }"#;
    let place =
        LabelCampaign::new(&small, &[("[label]\nmethod", &format!("[label]\nmethod = {command} # "))]);
    let here = place.path().canonicalize().unwrap();
    fs::write(here.join("label.sh"), SCRIPT.replace("HERE", &here.display().to_string())).unwrap();
    assert_eq!(place.run().0.wait().unwrap().code(), Some(0), "{}", place.said());
    assert!(place.jobs("labelled") > 1 && place.jobs("failed") == 0, "{}", place.said());
    place
}

fn read_json(place: &LabelCampaign, arguments: &[&str]) -> Json {
    let arguments = [&arguments[..1], &[place.argument()], &arguments[1..], &["--json"]].concat();
    serde_json::from_str(&succeed(place.path(), arguments)).unwrap()
}

/// Name, energy and retry adjustments of the exported frames that match a condition.
fn exported(place: &LabelCampaign, condition: &str) -> Vec<(String, f64, String)> {
    let arguments = ["export", place.argument(), "--control", "--where", condition, "--output", "out.extxyz"];
    succeed(place.path(), arguments);
    let frames = atoms::read_extxyz(&place.path().join("out.extxyz")).unwrap();
    let facts = frames.iter().map(|frame| {
        let text = |key: &str| frame.info.get(key).and_then(|value| value.text()).unwrap_or_default();
        let energy = frame.labels().unwrap().energy.unwrap();
        (text("candidate_id").to_owned(), energy, text("retry_adjustments").to_owned())
    });
    facts.collect()
}

/// Requests another label, which converges at once to this energy, and waits for it.
fn label_again(place: &LabelCampaign, candidate: &str, energy: &str) {
    fs::write(place.path().join("converges"), energy).unwrap();
    succeed(place.path(), ["relabel", place.argument(), candidate, "--reason", "which state?"]);
    assert_eq!(place.label(&["--until-empty"]).0.wait().unwrap().code(), Some(0), "{}", place.said());
}

fn check(here: &Path, argument: &str) {
    let found = succeed(here, ["store", "check", argument]);
    assert!(found.starts_with("no problems found"), "{found}");
}

#[test]
fn labels_say_that_their_moments_were_changed_and_lower_states_are_proposed() {
    let place = campaign();
    let (here, argument) = (place.path(), place.argument());
    let adjustments = "more_steps,slower_mixing,other_algorithm,other_moments";
    let all = exported(&place, "atoms > 0");
    assert!(all.iter().all(|(_, energy, names)| (*energy, names.as_str()) == (-2.5, adjustments)), "{all:?}");
    assert_eq!(exported(&place, "retry_adjustment = other_moments"), all);
    let name = all[0].0.as_str();
    assert_eq!(place.job(name).job.attempts, 4);
    let words = "computed with retry adjustments more_steps, slower_mixing, other_algorithm, other_moments (initial magnetic moments \
                 changed)";
    for command in [vec!["queue", argument, "show", name], vec!["explain", argument, name]] {
        let said = succeed(here, &command);
        assert!(said.contains(words), "{said}");
    }
    let explained = read_json(&place, &["explain", name]);
    assert_eq!(explained["labels"][0]["details"]["retry_adjustments"][3], "other_moments");
    let nothing = "every label is the lowest known state of its structure\n";
    assert_eq!(succeed(here, ["lower-states", argument]), nothing);
    assert_eq!(place.jobs("lower_states"), 0);
    assert!(!succeed(here, ["status", argument]).contains("lower magnetic states"));

    // Without changed moments, the calculation now finds a higher state: the label is what was requested.
    label_again(&place, name, "-0.5");
    let without = exported(&place, "retry_adjustment != other_moments");
    assert!(without.iter().all(|frame| *frame == (name.to_owned(), -0.5, String::new())), "{without:?}");
    assert_eq!((without.is_empty(), place.jobs("lower_states")), (false, 1));
    let status = succeed(here, ["status", argument]);
    assert!(
        status.contains("lower magnetic states are known of 1 structure (see calmwalk lower-states)"),
        "{status}"
    );
    let listed = read_json(&place, &["lower-states"]);
    let (label, lower) = (&listed[0]["label"], &listed[0]["lower"]);
    assert_eq!((&label["changed_moments"], &lower["changed_moments"]), (&json!(false), &json!(true)));
    assert!(lower["source"].as_str().unwrap().starts_with("attempt 4 of job "), "{lower}");
    let per_atom = |result: &Json| result["energy_per_atom"].as_f64().unwrap();
    let difference = per_atom(lower) - per_atom(label);
    assert!((difference * listed[0]["atoms"].as_f64().unwrap() + 2.0).abs() < 1e-9, "{listed}");
    assert_eq!(listed[0]["difference_per_atom"].as_f64(), Some(difference));
    let table = succeed(here, ["lower-states", argument]);
    assert!(
        table.lines().count() == 3 && table.contains("changed") && table.contains("as the protocol"),
        "{table}"
    );

    for (arguments, expected) in [
        (vec!["--reason", "x"], "--reason needs IDs or --all"),
        (vec!["--all", name], "cannot be used with"),
        (vec![name, "99.0.1"], "no candidate matches '99.0.1'"),
    ] {
        let message = refuse(here, [&["lower-states", argument], &arguments[..]].concat());
        assert!(message.contains(expected), "{message}");
    }
    assert_eq!(place.jobs("lower_states"), 1);
    let said = succeed(here, ["lower-states", argument, name, "--reason", "as in the experiment"]);
    assert!(
        said.contains(&format!("lower by {:.6} eV/atom; the label before is superseded", -difference)),
        "{said}"
    );
    assert_eq!(exported(&place, "atoms > 0"), all);
    let details = succeed(here, ["explain", argument, name]);
    for part in ["ago: a lower state: −", "eV/atom (as in the experiment)", "by the user: lower_state"] {
        assert!(details.contains(part), "{part} in {details}");
    }
    assert_eq!(succeed(here, ["lower-states", argument]), nothing);
    let again = succeed(here, ["lower-states", argument, name]);
    assert!(again.contains("nothing was changed"), "{again}");
    check(here, argument);
}

#[test]
fn the_lower_state_becomes_the_label_where_the_configuration_says_so() {
    let place = campaign();
    let (here, argument) = (place.path(), place.argument());
    let before = place.export();
    let name = exported(&place, "atoms > 0").remove(0).0;
    // A started campaign may change this rule.
    let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
    let text =
        text.replace("[label]", "[label]\non_lower_state = \"supersede\"\nmin_state_difference = 0.002");
    fs::write(here.join("campaign.toml"), text).unwrap();
    assert_eq!(place.run().0.wait().unwrap().code(), Some(0), "{}", place.said());

    // The requested label has a higher energy: the earlier label stays.
    label_again(&place, &name, "-0.5");
    assert!(place.said().contains("has a label already; this result is kept as a check"), "{}", place.said());
    assert_eq!((place.export(), place.jobs("lower_states"), place.jobs("queued")), (before, 0, 0));
    // The requested label has a lower energy.
    label_again(&place, &name, "-9.5");
    let found = exported(&place, "retry_adjustment != other_moments");
    assert!(
        !found.is_empty() && found.iter().all(|frame| *frame == (name.clone(), -9.5, String::new())),
        "{found:?}"
    );
    let labels = read_json(&place, &["explain", &name])["labels"].clone();
    let statuses: Vec<_> = labels.as_array().unwrap().iter().map(|label| label["status"].clone()).collect();
    assert_eq!(statuses, ["superseded", "check", "label"]);
    check(here, argument);
}
