//! A campaign whose potential is trained by gracemaker, by `configs/gracemaker.sh`, for two rounds. Needs a Python with
//! tensorpotential, named by `CALMWALK_GRACEMAKER_PYTHON` (`.ci/loaders` makes one), and the checkpoint of the model in
//! `CALMWALK_PEER_DATA`.
//!
//! By hand: `env $(.ci/loaders) CALMWALK_PEER_DATA=../shared cargo test --workspace --test external gracemaker_refit::`

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

use atoms::read_extxyz;
use store::VersionState;

use crate::common::campaign::Small;
use crate::common::label_campaign::on_store;
use crate::common::{config, program, stderr, succeed, write_frames};

/// Number of structures of the replay data.
const REPLAY: usize = 16;

fn variable(name: &str) -> PathBuf {
    env::var_os(name).map(PathBuf::from).unwrap_or_else(|| panic!("{name} is not set"))
}

/// Files the checkpoint of version 0 under the hash of its export.
fn file_checkpoint(here: &Path) {
    let hash = Command::new("sha256sum").arg(config("data/al_eam_1l/kokkos.npz")).output().unwrap();
    assert!(hash.status.success(), "{}", stderr(&hash));
    let folder = here.join("lineage").join(String::from_utf8_lossy(&hash.stdout[..64]).as_ref());
    fs::create_dir_all(&folder).unwrap();
    let checkpoint = variable("CALMWALK_PEER_DATA").join("models/al_eam_1l/gracemaker");
    for file in ["model.yaml", "checkpoint.index", "checkpoint.data-00000-of-00001"] {
        fs::write(folder.join(file), fs::read(checkpoint.join(file)).unwrap()).unwrap();
    }
}

#[test]
fn gracemaker_trains_two_versions() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    file_checkpoint(here);
    let frames = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    write_frames(&here.join("replay.extxyz"), &frames[..REPLAY]);
    let script = config("gracemaker.sh");
    let refit = format!(
        "[refit]\nreplay = [\"replay.extxyz\"]\nmax_versions = 2\nheld_out = 0.0\nmethod = {{ command = {{ program = [\"{}\"] }} }}\n",
        script.display()
    );
    let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
    fs::write(here.join("campaign.toml"), text + &refit).unwrap();
    let python = variable("CALMWALK_GRACEMAKER_PYTHON");
    let path = format!("{}:{}", python.parent().unwrap().display(), env::var("PATH").unwrap());
    let mut run = program(here);
    run.args(["run", "campaign.toml", "--directory", "campaign"]);
    run.env("PATH", path).env("LINEAGE", here.join("lineage")).env("EPOCHS", "2").env("BATCH_SIZE", "4");
    let run = run.output().unwrap();
    assert!(run.status.success(), "{}", stderr(&run));
    let versions = on_store(here.join("campaign").into(), async |store| store.versions().await.unwrap());
    assert_eq!(versions.len(), 2);
    assert!(versions.iter().all(|version| version.state == VersionState::Registered), "{versions:?}");
    // Each was trained from the checkpoint of the one before.
    assert_eq!(fs::read_dir(here.join("lineage")).unwrap().count(), 3);
    succeed(here, ["store", "check", "campaign"]);
    println!("{}", succeed(here, ["versions", "campaign", "show", "2"]));
}
