//! How the labels of a campaign are made, as its store says: for labellers that have no configuration at hand.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Deserialize;
use store::{Protocol, Store};

use crate::config::PotentialKind;
use crate::outcome::Failure;
use crate::setup::MethodSetup;

/// The key of the configuration that names the file of a reference potential.
pub const REFERENCE_FILE: &str = "label.method.reference.file";

/// Under which name the leader says in the store where those files are.
pub const LABEL_FILES: &str = "label_files";

/// Where the files are that labels are made with: the key of the configuration and the path.
pub type LabelFiles = BTreeMap<String, PathBuf>;

/// What a labeller needs to know of the campaign.
#[derive(Clone, Debug)]
pub struct Labelling {
    /// How labels are made, with files that are here.
    pub method: MethodSetup,
    /// The protocol of new jobs.
    pub protocol: Protocol,
    /// Attempts before a label counts as failed.
    pub attempts: u32,
    /// Largest force that is believed, eV/Å.
    pub largest_force: f64,
    /// How long a job is leased.
    pub lease: Duration,
}

/// Of the configuration in force, what concerns labels.
#[derive(Deserialize)]
struct InForce {
    label: LabelSection,
    /// BLAKE3 of every file by the key that names it.
    files: BTreeMap<String, String>,
}

#[derive(Deserialize)]
struct LabelSection {
    method: Method,
    attempts: u32,
    largest_force: f64,
    /// Campaigns of earlier versions have none.
    #[serde(default = "ten_minutes")]
    lease: u32,
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum Method {
    Reference { kind: PotentialKind },
}

fn ten_minutes() -> u32 {
    600
}

impl Method {
    /// As the configuration calls it.
    fn name(&self) -> &'static str {
        match self {
            Self::Reference { .. } => "reference",
        }
    }
}

impl Labelling {
    /// Reads it, and finds the files that the method needs: among `given`, or where the leader of the campaign has them.
    /// `protocol` is the one in force, `wanted` the name of the method that the user expects.
    pub async fn of(
        store: &Store,
        protocol: Protocol,
        wanted: Option<&str>,
        given: &[PathBuf],
    ) -> Result<Self, Failure> {
        let text = store.campaign().await?.configuration_in_force;
        let InForce { label, files: hashes } = serde_json::from_str(&text).map_err(|error| {
            Failure::Failed(format!(
                "the configuration in force cannot be read ({error}): the campaign may be one of another version of \
                 this program, or its database is damaged; calmwalk store check tells"
            ))
        })?;
        let found = label.method.name();
        if let Some(wanted) = wanted.filter(|wanted| *wanted != found) {
            return Err(Failure::Input(format!(
                "--method {wanted}, but the labels of this campaign are made by the method '{found}': leave --method out, \
                 or name the campaign that you mean"
            )));
        }
        let places = store.note(LABEL_FILES).await?.unwrap_or_default();
        let places: LabelFiles = serde_json::from_str(&places).unwrap_or_default();
        let files = Files { hashes: &hashes, places: &places, given: &given_files(given)? };
        let method = match label.method {
            Method::Reference { kind } => {
                let (file, file_hash) = files.find(REFERENCE_FILE)?;
                MethodSetup::Reference { kind, file, file_hash }
            }
        };
        files.all_given_are_needed(&[REFERENCE_FILE])?;
        let LabelSection { attempts, largest_force, lease, .. } = label;
        let lease = Duration::from_secs(lease.into());
        Ok(Self { method, protocol, attempts, largest_force, lease })
    }
}

/// The files that the user names, each with its BLAKE3.
fn given_files(given: &[PathBuf]) -> Result<Vec<(PathBuf, String)>, Failure> {
    let read = |path: &PathBuf| match hash(path) {
        Ok(hash) => Ok((std::path::absolute(path).map_err(Failure::failed)?, hash)),
        Err(error) => Err(Failure::Input(format!("--file {}: cannot be read ({error})", path.display()))),
    };
    given.iter().map(read).collect()
}

fn hash(path: &Path) -> std::io::Result<String> {
    Ok(blake3::hash(&fs::read(path)?).to_string())
}

/// Where files may be, and what must be in them.
struct Files<'a> {
    hashes: &'a BTreeMap<String, String>,
    places: &'a LabelFiles,
    given: &'a [(PathBuf, String)],
}

impl Files<'_> {
    /// The file of this key here, and its BLAKE3.
    fn find(&self, key: &str) -> Result<(PathBuf, String), Failure> {
        let expected = self.hashes.get(key).ok_or_else(|| {
            Failure::Failed(format!(
                "damaged database: the configuration in force has no hash of {key}; restore it from a copy"
            ))
        })?;
        if let Some((path, _)) = self.given.iter().find(|(_, hash)| hash == expected) {
            return Ok((path.clone(), expected.clone()));
        }
        let why = match self.places.get(key).map(|path| (path, hash(path))) {
            Some((path, Ok(found))) if found == *expected => return Ok((path.clone(), found)),
            Some((path, Ok(found))) => {
                format!("{} here has another content (BLAKE3 {found})", path.display())
            }
            Some((path, Err(error))) => format!("{} cannot be read here ({error})", path.display()),
            None => "the store does not say where it is".to_owned(),
        };
        Err(Failure::Input(format!(
            "{key}: labels of this campaign are made with the file of BLAKE3 {expected}, but {why}; copy it to this host \
             and name it with --file"
        )))
    }

    /// A file that nobody needs is most likely a wrong one.
    fn all_given_are_needed(&self, keys: &[&str]) -> Result<(), Failure> {
        let expected: Vec<_> = keys.iter().filter_map(|key| self.hashes.get(*key)).collect();
        match self.given.iter().find(|(_, hash)| !expected.contains(&hash)) {
            None => Ok(()),
            Some((path, hash)) => Err(Failure::Input(format!(
                "--file {}: its content (BLAKE3 {hash}) is not that of a file with which the labels of this campaign are \
                 made",
                path.display()
            ))),
        }
    }
}
