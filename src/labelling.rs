//! How the labels of a campaign are made, as its store says: for labellers that have no configuration at hand.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use atoms::Species;
use dft::Code;
use serde::Deserialize;
use serde_json::{Value, json};
use store::{Protocol, Store};
use wire::ContentHash;
use workers::labeller::LabelBounds;

use crate::config::{LabelMethod, LabelSection, PotentialFile, PotentialKind, changed_keys};
use crate::outcome::Failure;
use crate::setup::MethodSetup;

/// The key of the configuration that names the file of a reference potential.
pub const REFERENCE_FILE: &str = "label.method.reference.file";

/// Under which name the leader says in the store how it makes labels: a [`MethodSetup`] with paths of its host.
pub const LABEL_METHOD: &str = "label_method";

/// What a labeller needs to know of the campaign.
#[derive(Clone, Debug)]
pub struct Labelling {
    /// How labels are made, with files that are here.
    pub method: MethodSetup,
    /// The protocol of new jobs.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub attempts: u32,
    /// What is believed of a label.
    pub bounds: LabelBounds,
    /// How long a job is leased.
    pub lease: Duration,
}

/// What the user says of the host on which labels are made.
#[derive(Debug, Default)]
pub struct Here<'a> {
    /// The method that the campaign must have.
    pub method: Option<&'a str>,
    /// Files that are not where the leader has them.
    pub files: &'a [PathBuf],
    /// How its program is called here: another command, other paths, the same protocol.
    pub label: Option<LabelSection>,
}

/// Of the configuration in force, what concerns labels.
#[derive(Deserialize)]
struct InForce {
    label: Limits,
}

#[derive(Deserialize)]
struct Limits {
    attempts: u32,
    #[serde(flatten)]
    bounds: LabelBounds,
    /// Campaigns of earlier versions have none.
    #[serde(default = "ten_minutes")]
    lease: u32,
}

fn ten_minutes() -> u32 {
    600
}

/// The protocol with these settings: its hash is theirs.
pub fn protocol(name: &str, settings: Value) -> Protocol {
    let hash = ContentHash(*blake3::hash(settings.to_string().as_bytes()).as_bytes());
    Protocol { hash, name: name.to_owned(), settings }
}

/// Settings of the protocol of a program's labels.
pub fn identity(method: &str, code: &dyn Code) -> Value {
    json!({ "method": method, "settings": code.identity() })
}

/// The same of a reference potential.
pub fn reference_identity(kind: PotentialKind, file_hash: &str) -> Value {
    json!({ "method": "reference", "kind": kind, "file_hash": file_hash })
}

/// What of the method stands in the configuration of a campaign: what makes a label what it is. How its program is called may
/// change, and so may the places of files.
pub fn resolved_method(label: &LabelSection, protocol: &Protocol) -> Value {
    match &label.method {
        LabelMethod::Reference(PotentialFile { kind, .. }) => {
            json!({ "reference": { "kind": kind, "file": null } })
        }
        LabelMethod::Code(settings) => json!({ settings.name(): protocol.settings }),
    }
}

/// The configuration of a campaign with another protocol of labels.
pub fn with_protocol(configuration: &Value, label: &LabelSection, protocol: &Protocol) -> Value {
    let mut configuration = configuration.clone();
    configuration["label"]["protocol"] = json!(protocol.name);
    configuration["label"]["method"] = resolved_method(label, protocol);
    if let Some(files) = configuration["files"].as_object_mut() {
        files.remove(REFERENCE_FILE);
        if let LabelMethod::Reference(_) = label.method {
            files.insert(REFERENCE_FILE.to_owned(), protocol.settings["file_hash"].clone());
        }
    }
    configuration
}

/// Whether labels of these elements can be made; why not.
pub fn supports(label: &LabelSection, species: &BTreeSet<Species>) -> Result<(), String> {
    match &label.method {
        LabelMethod::Reference(reference) => {
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

impl Labelling {
    /// Reads it, and finds what the method needs here. `protocol` is the one in force.
    pub async fn of(store: &Store, protocol: Protocol, here: Here<'_>) -> Result<Self, Failure> {
        let text = store.campaign().await?.configuration_in_force;
        let InForce { label: Limits { attempts, bounds, lease } } =
            serde_json::from_str(&text).map_err(unreadable)?;
        let noted = store.metadata(LABEL_METHOD).await?.ok_or_else(|| {
            Failure::Failed(
                "the store does not say how labels are made: the campaign was last run by an earlier version of this \
                 program; run it once with this one"
                    .to_owned(),
            )
        })?;
        let noted: MethodSetup = serde_json::from_str(&noted).map_err(unreadable)?;
        let found = noted.name();
        if let Some(wanted) = here.method.filter(|wanted| *wanted != found) {
            return Err(Failure::Input(format!(
                "--method {wanted}, but the labels of this campaign are made by the method '{found}': leave --method out, \
                 or name the campaign that you mean"
            )));
        }
        let method = noted.for_this_host(&protocol, here)?;
        let lease = Duration::from_secs(lease.into());
        Ok(Self { method, protocol, attempts, bounds, lease })
    }
}

/// What the campaign believes of labels, as the configuration in force says.
pub async fn bounds(store: &Store) -> Result<LabelBounds, Failure> {
    let text = store.campaign().await?.configuration_in_force;
    let configuration: Value = serde_json::from_str(&text).map_err(unreadable)?;
    match &configuration["label"] {
        Value::Null => Ok(LabelBounds::default()),
        label => LabelBounds::deserialize(label).map_err(unreadable),
    }
}

fn unreadable(error: serde_json::Error) -> Failure {
    Failure::Failed(format!(
        "what the store says of labels cannot be read ({error}): the campaign may be one of another version of this \
         program, or its database is damaged; calmwalk store check tells"
    ))
}

impl MethodSetup {
    /// The method of a configuration, with absolute paths.
    pub fn of(label: &LabelSection) -> Result<Self, Failure> {
        let absolute = |path: &Path| std::path::absolute(path).map_err(Failure::failed);
        match &label.method {
            LabelMethod::Reference(PotentialFile { kind, file }) => {
                let file = file.get_ref();
                let file_hash = hash(file)
                    .map_err(|error| Failure::Input(format!("cannot read {}: {error}", file.display())))?;
                Ok(Self::Reference { kind: *kind, file: absolute(file)?, file_hash })
            }
            LabelMethod::Code(settings) => {
                let mut settings = Box::new(settings.clone());
                for path in settings.paths() {
                    *path = absolute(path)?;
                }
                Ok(Self::Code { settings, running: label.running() })
            }
        }
    }

    /// Settings of the protocol of its labels. A program must be there.
    pub fn identity(&self) -> Result<Value, Failure> {
        match self {
            Self::Reference { kind, file_hash, .. } => Ok(reference_identity(*kind, file_hash)),
            Self::Code { settings, running } => {
                let code = settings.prepare(&running.pass_environment).map_err(Failure::input)?;
                Ok(identity(settings.name(), &*code))
            }
        }
    }

    /// As the configuration calls it.
    fn name(&self) -> &'static str {
        match self {
            Self::Reference { .. } => "reference",
            Self::Code { settings, .. } => settings.name(),
        }
    }

    /// The same with what is on this host, if it makes labels of that protocol.
    fn for_this_host(self, protocol: &Protocol, here: Here<'_>) -> Result<Self, Failure> {
        let given = here.label.as_ref().map(Self::of).transpose()?;
        match (self, given) {
            (Self::Reference { kind, file, .. }, None) => {
                let (file, file_hash) = find(&file, protocol, here.files)?;
                Ok(Self::Reference { kind, file, file_hash })
            }
            (noted @ Self::Code { .. }, given) => {
                let (name, method) = (noted.name(), given.unwrap_or(noted));
                if let Some(file) = here.files.first() {
                    return Err(Failure::Input(format!(
                        "--file {}: where files of the method '{name}' are on this host is said in a --config",
                        file.display()
                    )));
                }
                if method.name() != name {
                    return Err(another_method(method.name(), name));
                }
                let identity = method.identity().map_err(|failure| {
                    Failure::Input(format!(
                        "labels cannot be made here: {failure}; if what is missing is elsewhere on this host, say so in a \
                         --config"
                    ))
                })?;
                agrees(&identity, protocol)?;
                Ok(method)
            }
            (Self::Reference { .. }, Some(given)) => Err(another_method(given.name(), "reference")),
        }
    }
}

/// Whether labels of that identity are labels of the protocol.
pub fn agrees(identity: &Value, protocol: &Protocol) -> Result<(), Failure> {
    match changed_keys(&protocol.settings, identity).first() {
        None => Ok(()),
        Some((key, before, after)) => Err(Failure::Input(format!(
            "labels made here would be of another protocol than '{}' of the campaign: {key} is {after} here, {before} \
             there",
            protocol.name
        ))),
    }
}

fn another_method(found: &str, expected: &str) -> Failure {
    Failure::Input(match (found, expected) {
        ("reference", "reference") => {
            "--config: the file of a reference potential is named with --file".to_owned()
        }
        _ => format!(
            "--config has the label method '{found}', but the labels of this campaign are made by '{expected}'"
        ),
    })
}

/// The file with which labels of that protocol are made, and its BLAKE3: one of those given, or where the leader has it.
fn find(noted: &Path, protocol: &Protocol, given: &[PathBuf]) -> Result<(PathBuf, String), Failure> {
    let expected = protocol.settings["file_hash"].as_str().unwrap_or_default();
    let mut found = None;
    for path in given {
        let hash = hash(path).map_err(|error| {
            Failure::Input(format!("--file {}: cannot be read ({error})", path.display()))
        })?;
        if hash != expected {
            // A file that nobody needs is most likely a wrong one.
            return Err(Failure::Input(format!(
                "--file {}: its content (BLAKE3 {hash}) is not that of the file with which the labels of this campaign \
                 are made",
                path.display()
            )));
        }
        found = Some((std::path::absolute(path).map_err(Failure::failed)?, hash));
    }
    if let Some(found) = found {
        return Ok(found);
    }
    let why = match hash(noted) {
        Ok(hash) if hash == expected => return Ok((noted.to_owned(), hash)),
        Ok(hash) => format!("{} here has another content (BLAKE3 {hash})", noted.display()),
        Err(error) => format!("{} cannot be read here ({error})", noted.display()),
    };
    Err(Failure::Input(format!(
        "{REFERENCE_FILE}: labels of this campaign are made with the file of BLAKE3 {expected}, but {why}; copy it to this \
         host and name it with --file"
    )))
}

fn hash(path: &Path) -> std::io::Result<String> {
    Ok(blake3::hash(&fs::read(path)?).to_string())
}
