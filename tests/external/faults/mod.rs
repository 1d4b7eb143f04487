//! What goes wrong on real machines: links between hosts, full disks, wrong clocks, labellers that sleep.
//!
//! `cargo test --test external -- faults:: --skip postgres_faults::`, as root, where namespaces may be made (a container needs the capabilities `SYS_ADMIN` and
//! `NET_ADMIN`), with iproute2, nftables, libfaketime, openssl and util-linux. A test fails that lacks what it needs.

mod cable;
mod clocks;
mod disk;
mod links;
mod model;

use std::process::Command;

/// Runs a command of the system, which must succeed.
fn must(command: &str) {
    let output = Command::new("sh").args(["-c", command]).output().expect("a shell");
    assert!(
        output.status.success(),
        "{command}: {}\nThis test needs root, namespaces, and the packages that tests/external/faults/mod.rs names.",
        String::from_utf8_lossy(&output.stderr)
    );
}
