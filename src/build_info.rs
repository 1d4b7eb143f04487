//! What this program is: version, commit, features, and the instruction sets that it uses on this machine.

use std::sync::LazyLock;

use potentials::grace::Instructions;

/// Short commit hash with its date, or `unknown`.
pub const COMMIT: &str = env!("CALMWALK_BUILD_COMMIT");

/// What `calmwalk --version` prints after the name.
pub fn long_version() -> &'static str {
    static TEXT: LazyLock<String> = LazyLock::new(|| {
        let rows = [
            ("commit", COMMIT.to_owned()),
            ("build", format!("{}, {}, {}", profile(), env!("CALMWALK_BUILD_TARGET"), compiler())),
            ("features", features().to_owned()),
            ("instructions", instructions()),
        ];
        let rows = rows.iter().map(|(name, value)| format!("\n{name:<13}{value}"));
        std::iter::once(env!("CARGO_PKG_VERSION").to_owned()).chain(rows).collect()
    });
    &TEXT
}

/// The instruction sets for which the potentials are compiled and that this machine has, the one that is used first.
pub fn instructions() -> String {
    let names: Vec<_> = Instructions::all().into_iter().map(Instructions::name).collect();
    match names.split_first() {
        Some((used, others)) if !others.is_empty() => format!("{used} (used), {}", others.join(", ")),
        _ => names.concat(),
    }
}

/// Optional features, and those that every build has.
fn features() -> &'static str {
    const BUILT_IN: &str = "SQLite, PostgreSQL with TLS, iceoryx2, zenoh";
    static TEXT: LazyLock<String> = LazyLock::new(|| match env!("CALMWALK_BUILD_FEATURES") {
        "" => BUILT_IN.to_owned(),
        optional => format!("{BUILT_IN}, {optional}"),
    });
    &TEXT
}

fn profile() -> &'static str {
    env!("CALMWALK_BUILD_PROFILE")
}

fn compiler() -> &'static str {
    env!("CALMWALK_BUILD_COMPILER")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_long_version_has_commit_features_and_instructions() {
        let text = long_version();
        let mut lines = text.lines();
        assert_eq!(lines.next(), Some(env!("CARGO_PKG_VERSION")));
        let names: Vec<_> = lines.filter_map(|line| line.split_whitespace().next()).collect();
        assert_eq!(names, ["commit", "build", "features", "instructions"]);
        assert!(text.contains(COMMIT) && text.contains(env!("CALMWALK_BUILD_TARGET")), "{text}");
        assert!(text.ends_with("baseline") || text.contains("(used)"), "{text}");
    }
}
