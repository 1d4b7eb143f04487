//! Configurations that are damaged at random: each is read, or refused by an error that names the file. `tests/mutations.rs` does
//! this to other files.

use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use super::Config;

#[path = "../../tests/common/mutate.rs"]
mod mutate;

use mutate::{mutated, mutations};

#[test]
fn damaged_configurations_are_refused_by_name() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("campaign.toml");
    let mut refused = 0;
    for name in ["aluminium.toml", "silicon.toml", "foundation-expansion.toml"] {
        let bytes = fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("configs").join(name)).unwrap();
        for number in 0..mutations(150) {
            fs::write(&path, mutated(&bytes, number)).unwrap();
            let found = catch_unwind(AssertUnwindSafe(|| Config::load(&path).map(drop)));
            let found = found.unwrap_or_else(|_| panic!("{name}: a panic at mutation {number}"));
            if let Err(why) = found {
                refused += 1;
                let why = why.to_string();
                assert!(
                    why.contains("campaign.toml") && why.len() < 3000,
                    "{name}, mutation {number}: {why}"
                );
            }
        }
    }
    assert!(refused > 0);
}
