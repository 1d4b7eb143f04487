//! Faults of real machines: broken links between hosts, full disks, wrong clocks, a killed orchestrator.
//!
//! `cargo test --test external -- faults:: --skip postgres_faults::` needs root, permission to create namespaces (in a
//! container, the capabilities `SYS_ADMIN` and `NET_ADMIN`), and iproute2, nftables, libfaketime, openssl and util-linux. A
//! test fails if a requirement is missing.

mod cable;
mod clocks;
mod disk;
mod links;
mod model;

use std::process::Command;

/// Runs a shell command, which must succeed.
fn must(command: &str) {
    let output = Command::new("sh").args(["-c", command]).output().expect("a shell");
    assert!(
        output.status.success(),
        "{command}: {}\nThis test needs root, namespaces, and the packages that tests/external/faults/mod.rs names.",
        String::from_utf8_lossy(&output.stderr)
    );
}
