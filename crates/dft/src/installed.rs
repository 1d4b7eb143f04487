//! The programs for labels that are on the path of this process.

use std::collections::BTreeMap;
use std::path::PathBuf;

use crate::{PassedEnvironment, SetupError, abinit, cp2k, espresso, executable, version_query};

/// A program that makes labels, by its usual name.
#[derive(Clone, Debug)]
pub struct InstalledCode {
    /// The name of its method in a configuration.
    pub method: &'static str,
    /// Its usual name.
    pub program: &'static str,
    /// Where it is; `None` if it is not on the path.
    pub path: Option<PathBuf>,
    /// Its version; `None` if it is not there, or if it tells its version in calculations only, as VASP does.
    pub version: Option<Result<String, SetupError>>,
}

/// How a program tells its version.
type VersionQuery =
    fn(&[String], &BTreeMap<String, String>, &PassedEnvironment) -> Result<String, SetupError>;

/// Method, usual name and query of each program.
const CODES: [(&str, &str, Option<VersionQuery>); 5] = [
    ("abinit", "abinit", Some(abinit::version)),
    ("cp2k", "cp2k", Some(cp2k::version)),
    ("espresso", "pw.x", Some(espresso::version)),
    ("gpaw", "gpaw", Some(gpaw_version)),
    ("vasp", "vasp_std", None),
];

/// Looks for each program on the path and asks for its version.
pub fn installed_codes() -> Vec<InstalledCode> {
    CODES.iter().map(|(method, program, query)| look_for(method, program, *query)).collect()
}

fn look_for(method: &'static str, program: &'static str, query: Option<VersionQuery>) -> InstalledCode {
    let path = executable::find(program).ok();
    let ask = |query: VersionQuery| {
        let environment = version_query::environment(&BTreeMap::new());
        query(&[program.to_owned()], &environment, &PassedEnvironment::default())
    };
    let version = path.as_ref().and(query).map(ask);
    InstalledCode { method, program, path, version }
}

/// The version of GPAW's own command, such as `22.8.0`.
fn gpaw_version(
    command: &[String],
    environment: &BTreeMap<String, String>,
    passed: &PassedEnvironment,
) -> Result<String, SetupError> {
    let said = version_query::run(command, &["--version"], environment, passed, &[])?;
    let version = said.split_whitespace().find_map(|word| word.strip_prefix("gpaw-"));
    version.map(str::to_owned).ok_or_else(|| {
        version_query::wrong_program(
            command,
            format!("is not GPAW: as its version it reports {:?}", said.trim()),
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_that_is_not_there_has_no_version() {
        let found = look_for("abinit", "no-such-program-of-calmwalk", Some(abinit::version));
        assert!(found.path.is_none() && found.version.is_none());
    }

    /// `echo` is on every path, and is none of these programs.
    #[test]
    fn another_program_of_that_name_is_an_error() {
        for (query, text) in [(abinit::version as VersionQuery, "ABINIT"), (gpaw_version, "GPAW")] {
            let found = query(&["echo".to_owned()], &BTreeMap::new(), &PassedEnvironment::default());
            let message = found.unwrap_err().to_string();
            assert!(message.contains(text), "{message}");
        }
    }
}
