//! The Python environment of Python potentials.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use super::check::MachineCheck;
use super::program;

/// Distributions, and what each is needed for.
const PACKAGES: [(&str, &str); 6] = [
    ("numpy", "every Python potential, calmwalk.open"),
    ("torch", "MACE and other models in PyTorch"),
    ("mace-torch", "MACE models"),
    ("tensorflow", "GRACE models by gracemaker"),
    ("tensorpotential", "GRACE models by gracemaker"),
    ("ase", "ASE calculators, structures of a campaign as Atoms"),
];

/// Prints the versions of the interpreter and of the distributions in its arguments, without importing them.
const SCRIPT: &str = r#"
import importlib.metadata, json, sys
def version(name):
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
print(json.dumps({"python": sys.version.split()[0], "packages": {name: version(name) for name in sys.argv[1:]}}))
"#;

/// What an environment has.
#[derive(Debug, Deserialize)]
struct PythonVersions {
    python: String,
    packages: BTreeMap<String, Option<String>>,
}

/// The interpreter of an environment and its packages. Which packages a potential needs, its adapter tells: only the interpreter
/// and numpy are required if an environment is named. The interpreter may be behind the words of a launcher.
pub fn checks(environment: Option<(&[String], &Path)>) -> Vec<MachineCheck> {
    let required = environment.is_some();
    const NAME: &str = "Python";
    const NEEDED_FOR: &str = "Python potentials, calmwalk.open";
    let interpreter = match environment {
        Some((launcher, environment)) => Some(interpreter(launcher, environment)),
        None => program::find("python3").map(|file| vec![file.display().to_string()]),
    };
    let Some(interpreter) = interpreter else {
        let advice = "install Python 3.11 or later, or name an environment with --python";
        return vec![MachineCheck::absent(NAME, "no python3 on the path", NEEDED_FOR, advice)];
    };
    match versions(&interpreter) {
        Ok(found) => {
            let text = format!("{}, {}", found.python, interpreter.join(" "));
            let mut checks = vec![MachineCheck::present(NAME, text, NEEDED_FOR)];
            checks.extend(packages(&found, &interpreter.join(" ")));
            let require = |check: MachineCheck| {
                let needed = required && check.name() == "numpy";
                check.required_if(needed)
            };
            checks.into_iter().map(require).collect()
        }
        Err(error) => {
            let found = format!("{}: {error}", interpreter.join(" "));
            let advice = "name a virtual environment, a conda prefix or an interpreter (--python, potential.python.environment)";
            vec![MachineCheck::absent(NAME, found, NEEDED_FOR, advice).required_if(required)]
        }
    }
}

/// The words that start the interpreter: that of a virtual environment or a conda prefix, or the file itself. Behind a launcher, only that
/// knows what the environment is.
fn interpreter(launcher: &[String], environment: &Path) -> Vec<String> {
    let is_directory = launcher.is_empty() && environment.is_dir();
    let program = if is_directory { environment.join("bin").join("python") } else { environment.to_owned() };
    launcher.iter().cloned().chain([program.display().to_string()]).collect()
}

fn versions(interpreter: &[String]) -> Result<PythonVersions, String> {
    let (program, words) = interpreter.split_first().ok_or("no interpreter")?;
    let names = PACKAGES.iter().map(|(name, _)| *name);
    let words = words.iter().map(String::as_str);
    let arguments: Vec<_> = words.chain(["-c", SCRIPT]).chain(names).collect();
    let said = program::ask(Path::new(program), &arguments)?;
    serde_json::from_str(&said).map_err(|_| format!("is no Python: it says {said:?}"))
}

/// The distributions that are there or not.
fn packages(found: &PythonVersions, interpreter: &str) -> Vec<MachineCheck> {
    let check = |&(name, needed_for): &(&'static str, &'static str)| match found.packages.get(name) {
        Some(Some(version)) => MachineCheck::present(name, version, needed_for),
        _ => {
            let advice = format!("{interpreter} -m pip install {name}");
            MachineCheck::absent(name, "not installed", needed_for, advice)
        }
    };
    PACKAGES.iter().map(check).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_environment_is_a_directory_or_an_interpreter() {
        let here = tempfile::tempdir().unwrap();
        let found = |environment: &Path| interpreter(&[], environment).join(" ");
        assert_eq!(found(here.path()), here.path().join("bin/python").display().to_string());
        assert_eq!(found(Path::new("/usr/bin/python3.11")), "/usr/bin/python3.11");
    }

    #[test]
    fn a_launcher_is_asked_for_the_interpreter_inside() {
        let launcher = ["env", "INSIDE=1"].map(str::to_owned);
        let found = checks(Some((&launcher, Path::new("python3"))));
        let json = serde_json::to_string(&found).unwrap();
        assert!(json.contains("env INSIDE=1 python3") && !found[0].is_missing(), "{json}");
    }

    #[test]
    fn packages_that_are_there_and_others_are_told_apart() {
        let said = r#"{"python": "3.11.2", "packages": {"numpy": "2.0.1", "torch": null}}"#;
        let found: PythonVersions = serde_json::from_str(said).unwrap();
        let checks = packages(&found, "/env/bin/python");
        let missing: Vec<_> = checks
            .into_iter()
            .map(|check| check.required_if(true))
            .filter(MachineCheck::is_missing)
            .collect();
        assert_eq!(missing.len(), PACKAGES.len() - 1);
        let json = serde_json::to_string(&missing[0]).unwrap();
        assert!(json.contains("/env/bin/python -m pip install torch"), "{json}");
    }

    #[test]
    fn what_is_no_python_is_told() {
        let found = checks(Some((&[], Path::new("/bin/echo"))));
        let json = serde_json::to_string(&found).unwrap();
        assert!(json.contains("is no Python"), "{json}");
        assert!(found[0].is_missing());
        let found = checks(Some((&[], Path::new("/no/such/python"))));
        assert!(found[0].is_missing() && found.len() == 1);
    }
}
