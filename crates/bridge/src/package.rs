//! The Python package `calmwalk`, which this program brings along, so that an environment needs the model's framework only.

use std::io;
use std::path::Path;

/// The text of modules of the package, by their path in it.
macro_rules! modules {
    ($($name:literal),* $(,)?) => {
        &[$(($name, include_str!(concat!("../../../python/calmwalk/", $name)))),*]
    };
}

/// What a server needs.
const MODULES: &[(&str, &str)] = modules![
    "__init__.py",
    "adapter.py",
    "adapters/__init__.py",
    "adapters/ase.py",
    "adapters/gracemaker.py",
    "adapters/mace.py",
    "adapters/radial.py",
    "adapters/simulated.py",
    "arenas.py",
    "batch.py",
    "errors.py",
    "loading.py",
    "protocol.py",
    "server.py",
];

/// Writes the package to `directory/calmwalk`.
///
/// # Errors
/// Errors of the file system.
pub(crate) fn write(directory: &Path) -> io::Result<()> {
    for (name, text) in MODULES {
        let path = directory.join("calmwalk").join(name);
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent)?;
        }
        std::fs::write(path, text)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All adapters, and all modules beside them that are not about campaigns.
    #[test]
    fn no_module_is_missing() {
        let package = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../python/calmwalk");
        let names = |folder: &str| -> Vec<String> {
            let files =
                std::fs::read_dir(package.join(folder)).unwrap().map(|file| file.unwrap().file_name());
            let names = files.map(|name| format!("{folder}{}", name.to_string_lossy()));
            names.filter(|name| name.ends_with(".py")).collect()
        };
        let known = |name: &&String| MODULES.iter().any(|(module, _)| module == name);
        let adapters = names("adapters/");
        assert_eq!(adapters.iter().filter(known).count(), adapters.len(), "{adapters:?}");
        // What the server imports; campaigns are read by who has installed the package.
        for (name, text) in MODULES {
            for line in text.lines().filter_map(|line| line.trim().strip_prefix("from .")) {
                let module = line.trim_start_matches('.').split_whitespace().next().unwrap_or_default();
                let file = format!("{module}.py");
                let is_there = ["", "import", "campaign"].contains(&module)
                    || MODULES.iter().any(|(path, _)| path.ends_with(&file));
                assert!(is_there || package.join(module).is_dir(), "{name} imports {module}");
            }
        }
    }
}
