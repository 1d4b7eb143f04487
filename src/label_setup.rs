//! How the labels of a campaign are made, as read from its store. Labellers without the configuration file use it.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Deserialize;
use serde_json::Value;
use store::{Protocol, Store};
use workers::labeller::LabelBounds;

use crate::config::{LabelSection, RunSection};
use crate::exit_status::CommandError;
use crate::file_hash::hash;
use crate::label_method::{MethodConfig, REFERENCE_FILE, check_protocol};

/// Metadata key under which the leader stores its [`MethodConfig`], with the paths of its host.
pub const LABEL_METHOD_KEY: &str = "label_method";

/// What a labeller needs to know about the campaign.
#[derive(Clone, Debug)]
pub struct LabelSetup {
    /// How to make labels, with files on this host.
    pub method: MethodConfig,
    /// The protocol of new jobs.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub max_attempts: u32,
    /// Limits of plausible labels.
    pub bounds: LabelBounds,
    /// How long a job is leased.
    pub lease_timeout: Duration,
}

/// Options for the host on which labels are made.
#[derive(Debug, Default)]
pub struct HostOptions<'a> {
    /// The method that the campaign must have.
    pub method: Option<&'a str>,
    /// Files that are not where the leader has them.
    pub files: &'a [PathBuf],
    /// How to call the program on this host: another command or other paths, but the same protocol.
    pub label: Option<LabelSection>,
}

/// The `[label]` section of the configuration in force.
#[derive(Deserialize)]
struct EffectiveConfig {
    label: LabelLimits,
}

#[derive(Deserialize)]
struct LabelLimits {
    max_attempts: u32,
    #[serde(flatten)]
    bounds: LabelBounds,
    lease_timeout: crate::duration::Duration,
}

impl LabelSetup {
    /// Reads the setup of `protocol`, which is in force, and locates on this host what the method needs.
    pub async fn read(
        store: &Store,
        protocol: Protocol,
        here: HostOptions<'_>,
    ) -> Result<Self, CommandError> {
        let text = store.campaign().await?.configuration_in_force;
        let EffectiveConfig { label: LabelLimits { max_attempts, bounds, lease_timeout } } =
            serde_json::from_str(&text).map_err(unreadable)?;
        let noted = store.metadata(LABEL_METHOD_KEY).await?.ok_or_else(|| {
            CommandError::Failed(
                "the store has no label settings: an earlier version of this program last ran the campaign; run it once \
                 with this one"
                    .to_owned(),
            )
        })?;
        let noted: MethodConfig = serde_json::from_str(&noted).map_err(unreadable)?;
        let found = noted.name();
        if let Some(wanted) = here.method.filter(|wanted| *wanted != found) {
            return Err(CommandError::Input(format!(
                "--method {wanted}, but the labels of this campaign are made by the method '{found}': leave --method out, \
                 or name the intended campaign"
            )));
        }
        let method = method_for_this_host(noted, &protocol, here)?;
        let lease_timeout = lease_timeout.get();
        Ok(Self { method, protocol, max_attempts, bounds, lease_timeout })
    }
}

/// `run.max_restarts` of the configuration in force, or its default where another version has written none.
pub async fn read_max_restarts(store: &Store) -> Result<u32, CommandError> {
    let text = store.campaign().await?.configuration_in_force;
    let configuration: Value = serde_json::from_str(&text).map_err(unreadable)?;
    let limit = configuration["run"]["max_restarts"].as_u64().and_then(|limit| u32::try_from(limit).ok());
    Ok(limit.unwrap_or(RunSection::default().max_restarts))
}

/// Limits of plausible labels, from the configuration in force.
pub async fn read_bounds(store: &Store) -> Result<LabelBounds, CommandError> {
    let text = store.campaign().await?.configuration_in_force;
    let configuration: Value = serde_json::from_str(&text).map_err(unreadable)?;
    match &configuration["label"] {
        Value::Null => Ok(LabelBounds::default()),
        label => LabelBounds::deserialize(label).map_err(unreadable),
    }
}

fn unreadable(error: serde_json::Error) -> CommandError {
    CommandError::Failed(format!(
        "cannot read the label settings in the store ({error}): another version of this program may have written them, \
         or the database is damaged; run calmwalk store check"
    ))
}

/// Replaces files and commands by those of this host. Fails if they would make labels of another protocol.
fn method_for_this_host(
    noted: MethodConfig,
    protocol: &Protocol,
    here: HostOptions<'_>,
) -> Result<MethodConfig, CommandError> {
    let given = here.label.as_ref().map(MethodConfig::from_section).transpose()?;
    match (noted, given) {
        (MethodConfig::Potential { kind, file, .. }, None) => {
            let (file, file_hash) = find_file(&file, protocol, here.files)?;
            Ok(MethodConfig::Potential { kind, file, file_hash })
        }
        (noted @ MethodConfig::Code { .. }, given) => {
            let (name, method) = (noted.name(), given.unwrap_or(noted));
            if let Some(file) = here.files.first() {
                return Err(CommandError::Input(format!(
                    "--file {}: give the files of the method '{name}' in a --config",
                    file.display()
                )));
            }
            if method.name() != name {
                return Err(method_mismatch(method.name(), name));
            }
            let identity = method.identity().map_err(|failure| {
                CommandError::Input(format!(
                    "cannot make labels on this host: {failure}; if the missing file or program has another path here, \
                     give it in a --config"
                ))
            })?;
            check_protocol(&identity, protocol)?;
            Ok(method)
        }
        (MethodConfig::Potential { .. }, Some(given)) => Err(method_mismatch(given.name(), "potential")),
    }
}

fn method_mismatch(found: &str, expected: &str) -> CommandError {
    CommandError::Input(match (found, expected) {
        ("potential", "potential") => {
            "--config: give the file of a reference potential with --file".to_owned()
        }
        _ => format!(
            "--config has the label method '{found}', but the labels of this campaign are made by '{expected}'"
        ),
    })
}

/// The file with which labels of the protocol are made, and its BLAKE3 hash: one of `given`, or the leader's file.
fn find_file(
    noted: &Path,
    protocol: &Protocol,
    given: &[PathBuf],
) -> Result<(PathBuf, String), CommandError> {
    let expected = protocol.settings["file_hash"].as_str().unwrap_or_default();
    let mut found = None;
    for path in given {
        let hash = hash(path).map_err(|error| {
            CommandError::Input(format!("--file {}: cannot be read ({error})", path.display()))
        })?;
        if hash != expected {
            // A file that is not needed is most likely a mistake.
            return Err(CommandError::Input(format!(
                "--file {}: its content (BLAKE3 {hash}) differs from that of the file that makes this campaign's \
                 labels",
                path.display()
            )));
        }
        found = Some((std::path::absolute(path).map_err(CommandError::failed)?, hash));
    }
    if let Some(found) = found {
        return Ok(found);
    }
    let why = match hash(noted) {
        Ok(hash) if hash == expected => return Ok((noted.to_owned(), hash)),
        Ok(hash) => format!("{} here has another content (BLAKE3 {hash})", noted.display()),
        Err(error) => format!("{} cannot be read here ({error})", noted.display()),
    };
    Err(CommandError::Input(format!(
        "{REFERENCE_FILE}: this campaign's labels need the file with BLAKE3 {expected}, but {why}; copy it to this \
         host and pass it with --file"
    )))
}
