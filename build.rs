//! Records what `calmwalk --version` tells about a build: its commit, target, profile, compiler and optional features.
//! Works without git and without a checkout, and runs again only when the commit changes.

use std::path::{Path, PathBuf};
use std::process::Command;

/// Names the commit where git cannot tell it, as in a container that gets the sources alone.
const GIVEN: &str = "CALMWALK_COMMIT";

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed={GIVEN}");
    for file in files_of_the_commit() {
        println!("cargo::rerun-if-changed={}", file.display());
    }
    let commit = std::env::var(GIVEN).ok().filter(|given| !given.is_empty()).or_else(commit);
    record("CALMWALK_BUILD_COMMIT", &commit.unwrap_or_else(|| "unknown".to_owned()));
    record("CALMWALK_BUILD_TARGET", &variable("TARGET"));
    record("CALMWALK_BUILD_PROFILE", &variable("PROFILE"));
    let compiler = output(Command::new(variable("RUSTC")).arg("--version"));
    record("CALMWALK_BUILD_COMPILER", &compiler.unwrap_or_else(|| "rustc of unknown version".to_owned()));
    record("CALMWALK_BUILD_FEATURES", &features());
}

fn record(name: &str, value: &str) {
    println!("cargo::rustc-env={name}={value}");
}

fn variable(name: &str) -> String {
    std::env::var(name).unwrap_or_default()
}

/// Hash and date of the commit, if these sources are a checkout of their own and not a folder of another one.
fn commit() -> Option<String> {
    let top = git(&["rev-parse", "--show-toplevel"])?;
    let here = Path::new(&variable("CARGO_MANIFEST_DIR")).canonicalize().ok()?;
    if Path::new(&top).canonicalize().ok()? != here {
        return None;
    }
    git(&["log", "-1", "--format=%h of %cs"])
}

/// The files that change with the commit: HEAD, and the branch that it names. Only files that exist: cargo takes a missing one
/// as changed, and would run this before every build.
fn files_of_the_commit() -> Vec<PathBuf> {
    let branch = git(&["symbolic-ref", "--quiet", "HEAD"]);
    let names = ["HEAD", "logs/HEAD", "packed-refs"].map(str::to_owned).into_iter().chain(branch);
    names
        .filter_map(|name| git(&["rev-parse", "--git-path", &name]))
        .map(PathBuf::from)
        .filter(|path| path.exists())
        .collect()
}

fn git(arguments: &[&str]) -> Option<String> {
    output(Command::new("git").args(arguments).current_dir(variable("CARGO_MANIFEST_DIR")))
}

/// The first line that a command prints, if it succeeds.
fn output(command: &mut Command) -> Option<String> {
    let output = command.output().ok().filter(|output| output.status.success())?;
    let text = String::from_utf8(output.stdout).ok()?;
    text.lines().next().map(str::to_owned).filter(|line| !line.is_empty())
}

/// Cargo's features of this build, separated by commas.
fn features() -> String {
    let mut names: Vec<String> = std::env::vars()
        .filter_map(|(name, _)| name.strip_prefix("CARGO_FEATURE_").map(str::to_lowercase))
        .filter(|name| name != "default")
        .collect();
    names.sort();
    names.join(", ")
}
