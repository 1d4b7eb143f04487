//! Energies of labels: which are believed.

mod common;

use std::fs;
use std::path::Path;

use common::campaign::Small;
use common::succeed;
use serde_json::Value as Json;
use tempfile::TempDir;

/// A calculation whose energy is what the awk expression ENERGY gives; N is the number of atoms, X the first coordinate of the second.
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

/// A campaign `here` whose labels have this energy, by an awk expression; `keys` are of `[label]`.
fn labelled_with(energy: &str, keys: &str) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let path = Small::default().write(directory.path());
    let text = fs::read_to_string(&path).unwrap();
    let method =
        "{ command = { command = [\"sh\", \"label.sh\"], files = [\"label.sh\"], version = \"1\" } }";
    let label = format!("[label]\nattempts = 1\n{keys}\nmethod = {method} # ");
    fs::write(path, text.replacen("[label]\nmethod = ", &label, 1)).unwrap();
    fs::write(directory.path().join("label.sh"), SCRIPT.replace("ENERGY", energy)).unwrap();
    succeed(directory.path(), ["run", "campaign.toml", "--directory", "here"]);
    directory
}

fn json<const N: usize>(here: &Path, arguments: [&str; N]) -> Json {
    serde_json::from_str(&succeed(here, arguments.into_iter().chain(["--json"]))).unwrap()
}

/// State of every job, number of atoms, and what its last attempt left as its log.
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
        let message = format!("an energy of {energy} eV/atom, beyond label.largest_energy = 2000000 eV/atom");
        assert!(state == "failed" && log.starts_with("implausible") && log.contains(&message), "{log}");
    }
}

/// The bounds are keys of the configuration, also where nothing runs.
#[test]
fn bounds_are_those_of_the_configuration() {
    let directory = labelled_with("-56.5 * N", "largest_energy = 50.0");
    for (state, _, log) in jobs(directory.path()) {
        let message = "an energy of -56.5 eV/atom, beyond label.largest_energy = 50 eV/atom";
        assert!(state == "failed" && log.contains(message), "{log}");
    }
    let here = directory.path();
    let arguments = ["label", "--once", "seeds.extxyz", "--config", "campaign.toml"];
    let output = common::calmwalk(here, arguments);
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(said.contains("beyond label.largest_energy = 50 eV/atom"), "{said} {}", common::stderr(&output));
}
