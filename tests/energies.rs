//! Energies of labels: which are accepted, and the energy errors of the potential without the offset between the zeros of
//! energy.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde_json::Value as Json;
use store::{ExportFilter, ExportSource, Store};
use tempfile::TempDir;

use crate::common;
use crate::common::campaign::Small;
use crate::common::succeed;

/// A calculation whose energy is the awk expression ENERGY; N is the number of atoms, X the x coordinate of the second atom.
const SCRIPT: &str = r#"
N=$(head -n 1 structure.extxyz)
X=$(awk 'NR == 4 { print $2 }' structure.extxyz)
E=$(awk -v N="$N" -v X="$X" 'BEGIN { print ENERGY }')
awk -v E="$E" '
    NR == 1 { print; next }
    NR == 2 { sub(/Properties=[^ ]*/, "Properties=species:S:1:pos:R:3:forces:R:3"); print $0 " energy=" E; next }
    { print $0, 0.25, 0, 0 }
' structure.extxyz > unfinished
mv unfinished label.extxyz
"#;

/// Two frames; the energy of the second is larger in magnitude.
const IMPORTED: &str = r#"1
Lattice="9 0 0 0 9 0 0 0 9" Properties=species:S:1:pos:R:3:forces:R:3 pbc="T T T" energy=-40
Al 0 0 0 0 0 0
1
Lattice="8 0 0 0 8 0 0 0 8" Properties=species:S:1:pos:R:3:forces:R:3 pbc="T T T" energy=-60
Al 0 0 0 0 0 0
"#;

/// A finished campaign `here` whose label energies are given by an awk expression; `keys` are added to `[label]`.
fn labelled_with(energy: &str, keys: &str) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let path = Small::default().write(directory.path());
    let text = fs::read_to_string(&path).unwrap();
    let method =
        "{ command = { command = [\"sh\", \"label.sh\"], files = [\"label.sh\"], version = \"1\" } }";
    let label = format!("[label]\nmax_attempts = 1\n{keys}\nmethod = {method} # ");
    fs::write(path, text.replacen("[label]\nmethod = ", &label, 1)).unwrap();
    fs::write(directory.path().join("label.sh"), SCRIPT.replace("ENERGY", energy)).unwrap();
    succeed(directory.path(), ["run", "campaign.toml", "--directory", "here"]);
    directory
}

fn json<const N: usize>(here: &Path, arguments: [&str; N]) -> Json {
    serde_json::from_str(&succeed(here, arguments.into_iter().chain(["--json"]))).unwrap()
}

/// State, number of atoms and log of the first attempt of every job.
fn jobs(here: &Path) -> Vec<(String, u64, String)> {
    let jobs = json(here, ["queue", "here", "list", "--limit", "1000"]);
    let one = |job: &Json| {
        let shown = json(here, ["queue", "here", "show", job["candidate"].as_str().unwrap()]);
        let attempt = &shown["attempts_made"][0];
        let log = format!("{} {}", attempt["class"].as_str().unwrap_or_default(), attempt["log"]);
        (job["state"].as_str().unwrap().to_owned(), job["atoms"].as_u64().unwrap(), log)
    };
    jobs.as_array().unwrap().iter().map(one).collect()
}

#[test]
fn an_absurd_energy_is_a_failed_attempt() {
    let directory = labelled_with("(N % 2 ? \"1e300\" : -56.5 * N)", "");
    let jobs = jobs(directory.path());
    assert!(
        jobs.iter().any(|(_, atoms, _)| atoms % 2 == 1) && jobs.iter().any(|(_, atoms, _)| atoms % 2 == 0)
    );
    for (state, atoms, log) in jobs {
        if atoms % 2 == 0 {
            assert_eq!(state, "labelled");
            continue;
        }
        let energy = format!("{:.3e}", 1e300 / atoms as f64);
        let message =
            format!("an energy of {energy} eV/atom, beyond label.max_energy_per_atom = 2000000 eV/atom");
        assert!(state == "failed" && log.starts_with("implausible") && log.contains(&message), "{log}");
    }
}

/// The configured bounds also apply to `import` and `label-file`.
#[test]
fn bounds_are_those_of_the_configuration() {
    let directory = labelled_with("-56.5 * N", "max_energy_per_atom = 50.0");
    for (state, _, log) in jobs(directory.path()) {
        let message = "an energy of -56.5 eV/atom, beyond label.max_energy_per_atom = 50 eV/atom";
        assert!(state == "failed" && log.contains(message), "{log}");
    }
    let here = directory.path();
    // Without labels there are no energy errors, and the output gives the reason.
    let errors = json(here, ["force-errors", "here"]);
    assert_eq!(
        (&errors["energy"]["mean"], &errors["energy"]["offsets"]["structures"]),
        (&Json::Null, &0.into())
    );
    let told = succeed(here, ["force-errors", "here"]);
    assert!(
        told.contains("no energy errors: ") && told.contains("at least 2 labelled structures; there are 0"),
        "{told}"
    );
    // An import is checked as well.
    fs::write(here.join("known.extxyz"), IMPORTED).unwrap();
    let message = common::refuse(here, ["import", "here", "known.extxyz"]);
    assert!(
        message.contains(
            "known.extxyz:4: an energy of -60 eV/atom, beyond label.max_energy_per_atom = 50 eV/atom"
        ),
        "{message}"
    );
    assert_eq!(json(here, ["status", "here"])["imported"], 0);
    let arguments = ["label-file", "seeds.extxyz", "--config", "campaign.toml"];
    let output = common::calmwalk(here, arguments);
    assert_eq!(output.status.code(), Some(1));
    let said = common::stderr(&output);
    assert!(said.contains("beyond label.max_energy_per_atom = 50 eV/atom"), "{said}");
}

/// Energies of the potential and of the label, eV/atom, and the structure's hash, by candidate.
fn energies(here: &Path) -> BTreeMap<String, (f64, f64, String)> {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let rows = runtime.block_on(async {
        let store = Store::open_read_only(here.join("here")).await.unwrap();
        let protocol = store.protocol_in_force().await.unwrap().unwrap().hash;
        let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
        store.labelled(&filter, None, u32::MAX).await.unwrap()
    });
    let one = |row: store::ExportRow| {
        let ExportSource::Candidate { id, block, .. } = row.source else { panic!("an import") };
        let atoms = row.structure.len() as f64;
        let content = block.view().id().content.to_string();
        (id, (block.view().energy() / atoms, row.label.energy / atoms, content))
    };
    rows.into_iter().map(one).collect()
}

/// Mean of E_label − E_model per atom over structures; a structure shared by walks and controls counts once.
fn offset(energies: &BTreeMap<String, (f64, f64, String)>) -> f64 {
    let differences: BTreeMap<_, _> =
        energies.values().map(|(model, label, content)| (content, label - model)).collect();
    differences.values().sum::<f64>() / differences.len() as f64
}

fn near(found: &Json, expected: f64) {
    let found = found.as_f64().unwrap();
    assert!((found - expected).abs() < 1e-9, "{found} is not {expected}");
}

#[test]
fn energy_errors_are_without_the_difference_of_zeros() {
    let directory = labelled_with("N * (-56.5 + 0.01 * X)", "");
    let here = directory.path();
    let energies = energies(here);
    let offset = offset(&energies);
    assert!(energies.len() > 4 && offset < -50.0, "{offset}");
    let errors: BTreeMap<_, _> =
        energies.iter().map(|(id, (model, label, _))| (id, model - label + offset)).collect();
    // A structure that a walk shares with its control walk counts once.
    let of_structures: BTreeMap<_, _> =
        energies.values().map(|(model, label, content)| (content, model - label + offset)).collect();

    let shown = json(here, ["force-errors", "here"])["energy"].clone();
    near(&shown["offsets"]["elements"][0]["offset"], offset);
    assert_eq!(
        (&shown["offsets"]["elements"][0]["element"], shown["structures"].as_u64()),
        (&"Al".into(), Some(of_structures.len() as u64))
    );
    let sum: f64 = of_structures.values().map(|error| error.abs()).sum();
    near(&shown["mean"], sum / of_structures.len() as f64);
    near(&shown["largest"], errors.values().fold(0.0, |largest: f64, error| largest.max(error.abs())));
    let note =
        format!("energy errors exclude the element offsets (eV/atom, E_label − E_model): Al {offset:.4}");
    for (id, error) in &errors {
        let details = json(here, ["explain", "here", id]);
        let model = &details["labels"][0]["model"];
        near(&model["energy_error_per_atom"], *error);
        near(&model["energy_per_atom"], error - offset);
        let told = succeed(here, ["explain", "here", id]);
        let line = format!("E_model − E_label: {:.1} meV/atom", 1000.0 * error);
        assert!(told.contains(&line) && told.contains(&note), "{line}\n{told}");
    }
    // No output includes the offset between the zeros of energy in an error.
    let summary = succeed(here, ["run", "campaign.toml", "--directory", "here"]);
    let told = succeed(here, ["force-errors", "here"]);
    succeed(here, ["report", "here", "--output", "report"]);
    let table = fs::read_to_string(here.join("report/tables/energy-offsets.csv")).unwrap();
    assert!(table.contains(&format!("Al,{offset}")[..12]), "{table}");
    let facts = fs::read_to_string(here.join("report/tables/summary.csv")).unwrap();
    for text in [&summary, &told] {
        assert!(text.contains(&note) && text.contains("meV/atom, over "), "{text}");
    }
    let mean = format!("mean {:.1}, ", 1000.0 * shown["mean"].as_f64().unwrap());
    assert!(facts.contains(&mean) && told.contains(&mean), "{facts} {told}");
}
