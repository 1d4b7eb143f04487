//! How the labels of a campaign are made: by a potential or by a program, with files at their paths on this host.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use atoms::Species;
use dft::DftBackend;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use store::Protocol;
use wire::ContentHash;
use workers::labeller::{ExecutionSettings, Method};

use crate::config::{LabelMethod, LabelSection, PotentialConfig, PotentialKind, changed_keys};
use crate::exit_status::CommandError;
use crate::file_hash::{hash, verify_hash};

/// Configuration key of a reference potential's file.
pub const REFERENCE_FILE: &str = "label.method.potential.file";

/// How labels are made.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum MethodConfig {
    /// With a potential that calmwalk evaluates.
    Potential {
        /// Format of the potential's file.
        kind: PotentialKind,
        /// The potential.
        file: PathBuf,
        /// BLAKE3 hash of that file.
        file_hash: String,
    },
    /// With an external program.
    Code {
        /// The program and the protocol.
        settings: Box<dft::DftSettings>,
        /// How its calculations run.
        running: ExecutionSettings,
    },
}

impl MethodConfig {
    /// The method of a configuration, with absolute paths.
    pub fn from_section(label: &LabelSection) -> Result<Self, CommandError> {
        let absolute = |path: &Path| std::path::absolute(path).map_err(CommandError::failed);
        match &label.method {
            LabelMethod::Potential(PotentialConfig { kind, file }) => {
                let file = file.get_ref();
                let file_hash = hash(file).map_err(|error| {
                    CommandError::Input(format!("cannot read {}: {error}", file.display()))
                })?;
                Ok(Self::Potential { kind: *kind, file: absolute(file)?, file_hash })
            }
            LabelMethod::Code(settings) => {
                let mut settings = settings.clone();
                for path in settings.paths() {
                    *path = absolute(path)?;
                }
                Ok(Self::Code { settings, running: label.execution_settings() })
            }
        }
    }

    /// Protocol settings of the labels. A program must be installed.
    pub fn identity(&self) -> Result<Value, CommandError> {
        match self {
            Self::Potential { kind, file_hash, .. } => Ok(potential_identity(*kind, file_hash)),
            Self::Code { settings, running } => {
                let code = settings.prepare(&running.pass_environment).map_err(CommandError::input)?;
                Ok(code_identity(settings.name(), &*code))
            }
        }
    }

    /// Name of the method in the configuration.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Potential { .. } => "potential",
            Self::Code { settings, .. } => settings.name(),
        }
    }
    /// Prepares the method to label by `protocol`. Fails if a file or program has been replaced.
    pub fn load(&self, protocol: &Protocol) -> Result<Method, CommandError> {
        match self {
            Self::Potential { kind, file, file_hash } => {
                verify_hash(file, file_hash)?;
                let potential = kind.load(file).map_err(CommandError::Input)?;
                // Detects a file that was replaced while it was read.
                verify_hash(file, file_hash)?;
                Ok(Method::reference(potential))
            }
            Self::Code { settings, running } => {
                let code = settings.prepare(&running.pass_environment).map_err(CommandError::input)?;
                check_protocol(&code_identity(settings.name(), &*code), protocol)?;
                Ok(Method::code(code, running.clone()))
            }
        }
    }
}

/// The protocol with these settings. Its hash is that of the settings.
pub fn protocol(name: &str, settings: Value) -> Protocol {
    let hash = ContentHash(*blake3::hash(settings.to_string().as_bytes()).as_bytes());
    Protocol { hash, name: name.to_owned(), settings }
}

/// Protocol settings of a program's labels.
pub fn code_identity(method: &str, code: &dyn DftBackend) -> Value {
    json!({ "method": method, "settings": code.identity() })
}

/// Protocol settings of a reference potential.
pub fn potential_identity(kind: PotentialKind, file_hash: &str) -> Value {
    json!({ "method": "potential", "kind": kind, "file_hash": file_hash })
}

/// The part of the label method that a campaign's configuration records: what determines the labels. The command and
/// the paths of files may change.
pub fn resolved_method(label: &LabelSection, protocol: &Protocol) -> Value {
    match &label.method {
        LabelMethod::Potential(PotentialConfig { kind, .. }) => {
            json!({ "potential": { "kind": kind, "file": null } })
        }
        LabelMethod::Code(settings) => json!({ settings.name(): protocol.settings }),
    }
}

/// The configuration of a campaign with another label protocol.
pub fn with_protocol(configuration: &Value, label: &LabelSection, protocol: &Protocol) -> Value {
    let mut configuration = configuration.clone();
    configuration["label"]["protocol"] = json!(protocol.name);
    configuration["label"]["method"] = resolved_method(label, protocol);
    if let Some(files) = configuration["files"].as_object_mut() {
        files.remove(REFERENCE_FILE);
        if let LabelMethod::Potential(_) = label.method {
            files.insert(REFERENCE_FILE.to_owned(), protocol.settings["file_hash"].clone());
        }
    }
    configuration
}

/// Checks that labels can be made for these elements.
pub fn supports(label: &LabelSection, species: &BTreeSet<Species>) -> Result<(), String> {
    match &label.method {
        LabelMethod::Potential(reference) => {
            let potential = reference.load()?;
            match species.iter().find(|species| !potential.species().contains(species)) {
                Some(missing) => Err(format!("the label potential does not know {missing}")),
                None => Ok(()),
            }
        }
        LabelMethod::Code(settings) => {
            let code = settings.prepare(&label.pass_environment).map_err(|error| error.to_string())?;
            code.supports(species).map_err(|error| error.to_string())
        }
    }
}

/// Checks that labels with these settings belong to the protocol.
pub fn check_protocol(identity: &Value, protocol: &Protocol) -> Result<(), CommandError> {
    match changed_keys(&protocol.settings, identity).first() {
        None => Ok(()),
        Some((key, before, after)) => Err(CommandError::Input(format!(
            "labels made here would not belong to the campaign's protocol '{}': {key} is {after} here, but {before} \
             in the protocol",
            protocol.name
        ))),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_replaced_program_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let script = directory.path().join("label.sh");
        fs::write(&script, "exit 0").unwrap();
        let settings = serde_json::json!({ "command": {
            "command": ["sh", "label.sh"], "files": [script], "version": "1"
        } });
        let settings = Box::new(serde_json::from_value(settings).unwrap());
        let method = MethodConfig::Code { settings, running: ExecutionSettings::default() };
        let protocol = protocol("script", method.identity().unwrap());
        assert!(method.load(&protocol).is_ok());
        fs::write(&script, "exit 1").unwrap();
        let message = method.load(&protocol).map(drop).unwrap_err().to_string();
        assert!(
            message.contains("not belong to the campaign's protocol 'script'")
                && message.contains("label.sh"),
            "{message}"
        );
    }
}
