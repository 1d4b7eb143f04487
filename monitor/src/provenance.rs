//! Records which configuration file a campaign belongs to, so that a run with another file does not continue the
//! campaign by mistake.

use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};
use store::{Store, StoreError};

/// Metadata key in the store.
pub const METADATA_KEY: &str = "configuration_file";

/// A common name of configuration files. The directory then names the campaign.
const GENERIC_STEM: &str = "campaign";

/// A configuration file at the time of a run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConfigFile {
    /// Absolute path without symbolic links.
    pub path: String,
    /// BLAKE3 hash of its content.
    pub blake3: String,
}

/// Name of a campaign and its configuration files.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Provenance {
    /// Name of the campaign: that of its configuration file, or of the directory of a `campaign.toml`.
    pub name: String,
    /// The file with which the campaign started.
    pub began_with: ConfigFile,
    /// The file of the last run.
    pub file: ConfigFile,
    /// A file whose `[label]` section `calmwalk relabel` has put into force since. It may become the campaign's file.
    #[serde(default)]
    pub relabelled_by: Option<ConfigFile>,
    /// Directory of the campaign in the last run, absolute and without symbolic links.
    pub directory: String,
}

/// How a file relates to the configuration of a campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConfigMatch {
    /// It is the file of the last run or of the last `calmwalk relabel`.
    Same,
    /// Campaign and configuration were moved together.
    MovedTogether,
    /// The file of the last run is gone, and this one has the same content.
    Renamed,
    /// It is another file.
    Other,
}

impl ConfigFile {
    fn new(path: &Path, text: &str) -> Self {
        let blake3 = blake3::hash(text.as_bytes()).to_string();
        Self { path: path.to_string_lossy().into_owned(), blake3 }
    }
}

impl Provenance {
    /// For a campaign in `directory` that starts with the configuration at `path`, whose content is `text`.
    pub fn new(path: &Path, text: &str, directory: &Path) -> Self {
        let path = canonical(path);
        let file = ConfigFile::new(&path, text);
        let directory = canonical(directory).to_string_lossy().into_owned();
        Self { name: name(&path), began_with: file.clone(), file, relabelled_by: None, directory }
    }

    /// Reads it from the store. `None` for campaigns of early versions.
    pub async fn read(store: &Store) -> Result<Option<Self>, StoreError> {
        let metadata = store.metadata(METADATA_KEY).await?;
        Ok(metadata.and_then(|text| serde_json::from_str(&text).ok()))
    }

    /// Compares the configuration of a run (`now`) with that of the campaign. `holds_campaign` says whether the
    /// directory contains the database, so that copying both makes a separate campaign. `file_exists` checks for a
    /// file.
    pub fn compare(
        &self,
        now: &Self,
        holds_campaign: bool,
        file_exists: impl Fn(&Path) -> bool,
    ) -> ConfigMatch {
        let known = [Some(&self.file), self.relabelled_by.as_ref()];
        if known.into_iter().flatten().any(|known| known.path == now.file.path) {
            ConfigMatch::Same
        } else if holds_campaign && self.relative() == now.relative() {
            ConfigMatch::MovedTogether
        } else if self.file.blake3 == now.file.blake3 && !file_exists(Path::new(&self.file.path)) {
            ConfigMatch::Renamed
        } else {
            ConfigMatch::Other
        }
    }

    /// The provenance after a run with the configuration of `now`.
    pub fn continued(&self, now: &Self) -> Self {
        Self { began_with: self.began_with.clone(), ..now.clone() }
    }

    /// The provenance after the `[label]` section of the file at `path`, whose content is `text`, came into force.
    pub fn relabelled(self, path: &Path, text: &str) -> Self {
        Self { relabelled_by: Some(ConfigFile::new(&canonical(path), text)), ..self }
    }

    /// The configuration's path relative to the campaign's directory: levels up, then the path down.
    fn relative(&self) -> (usize, PathBuf) {
        let (file, directory) = (Path::new(&self.file.path), Path::new(&self.directory));
        let common = file.components().zip(directory.components()).take_while(|(a, b)| a == b).count();
        let up = directory.components().count() - common;
        (up, file.components().skip(common).collect())
    }
}

fn name(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let parent = path.parent().and_then(|parent| parent.components().next_back());
    match parent {
        Some(Component::Normal(parent)) if stem == GENERIC_STEM => parent.to_string_lossy().into_owned(),
        _ => stem,
    }
}

fn canonical(path: &Path) -> PathBuf {
    path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn origin(path: &str, text: &str, directory: &str) -> Provenance {
        Provenance::new(Path::new(path), text, Path::new(directory))
    }

    #[test]
    fn a_campaign_is_named_after_its_configuration() {
        for (path, expected) in [
            ("/no/such/second/campaign.toml", "second"),
            ("/no/such/second/hot.toml", "hot"),
            ("/campaign.toml", "campaign"),
        ] {
            assert_eq!(origin(path, "", "/no/such").name, expected);
        }
    }

    #[test]
    fn another_file_does_not_match() {
        let first = origin("/no/first/campaign.toml", "a", "/no/first/campaign");
        let compare =
            |now: &Provenance, holds_campaign, exists: bool| first.compare(now, holds_campaign, |_| exists);
        let second = origin("/no/second/campaign.toml", "a", "/no/first/campaign");
        assert_eq!(compare(&first, true, true), ConfigMatch::Same);
        assert_eq!(compare(&second, true, true), ConfigMatch::Other, "the content does not tell files apart");
        assert_eq!(compare(&second, true, false), ConfigMatch::Renamed);
        let edited = origin("/no/second/campaign.toml", "b", "/no/first/campaign");
        assert_eq!(compare(&edited, true, false), ConfigMatch::Other);
        let together = origin("/no/second/campaign.toml", "b", "/no/second/campaign");
        assert_eq!(compare(&together, true, true), ConfigMatch::MovedTogether);
        assert_eq!(
            compare(&together, false, true),
            ConfigMatch::Other,
            "a server holds the campaign of both copies"
        );
    }

    #[test]
    fn the_first_configuration_is_kept() {
        let first = origin("/no/first/campaign.toml", "a", "/no/first/campaign");
        let now = first.continued(&origin("/no/second/hot.toml", "b", "/no/second/hot"));
        assert_eq!((now.name.as_str(), &now.began_with), ("hot", &first.file));
        assert_eq!(now.file.path, "/no/second/hot.toml");
        let relabelled = first.clone().relabelled(Path::new("/no/first/fine.toml"), "c");
        for path in ["/no/first/campaign.toml", "/no/first/fine.toml"] {
            let now = origin(path, "d", "/no/elsewhere");
            assert_eq!(relabelled.compare(&now, true, |_| true), ConfigMatch::Same, "{path}");
            assert_eq!(relabelled.continued(&now).relabelled_by, None);
        }
    }
}
