//! Which configuration file a campaign belongs to. The store records it, so that a run with another file does not go on with the
//! campaign by mistake.

use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};
use store::{Store, StoreError};

/// Under which name the store has it.
pub const NOTE: &str = "configuration_file";

/// A configuration that many campaigns have: its directory names the campaign.
const COMMON_STEM: &str = "campaign";

/// A configuration file at the time of a run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConfigFile {
    /// Absolute path without symbolic links.
    pub path: String,
    /// BLAKE3 of its content.
    pub blake3: String,
}

/// Name of a campaign, and its configuration.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// Name of the campaign: that of its configuration, or of the directory of a `campaign.toml`.
    pub name: String,
    /// The file with which the campaign began.
    pub began_with: ConfigFile,
    /// The file of the last run.
    pub file: ConfigFile,
    /// A file whose `[label]` section `calmwalk relabel` has brought into force since: it may become the campaign's.
    #[serde(default)]
    pub relabelled_by: Option<ConfigFile>,
    /// Directory of the campaign in the last run, absolute and without symbolic links.
    pub directory: String,
}

/// Why a file is taken for the configuration of a campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Match {
    /// It is the file of the last run, or of the last `calmwalk relabel`.
    Same,
    /// Campaign and configuration were moved together.
    MovedTogether,
    /// The file of the last run is gone, and this one has its content.
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

impl Origin {
    /// The origin of a campaign in `directory` that begins with the configuration at `path`, which holds `text`.
    pub fn new(path: &Path, text: &str, directory: &Path) -> Self {
        let path = canonical(path);
        let file = ConfigFile::new(&path, text);
        let directory = canonical(directory).to_string_lossy().into_owned();
        Self { name: name(&path), began_with: file.clone(), file, relabelled_by: None, directory }
    }

    /// That of a campaign; none of one that began with an early version.
    pub async fn of(store: &Store) -> Result<Option<Self>, StoreError> {
        let note = store.metadata(NOTE).await?;
        Ok(note.and_then(|note| serde_json::from_str(&note).ok()))
    }

    /// How the configuration of a run (`now`) stands to that of the campaign. `holds_campaign`: the campaign's directory has its
    /// database, so that a copy of both is a campaign of its own. `file_exists` tells whether a file is there.
    pub fn compare(&self, now: &Self, holds_campaign: bool, file_exists: impl Fn(&Path) -> bool) -> Match {
        let known = [Some(&self.file), self.relabelled_by.as_ref()];
        if known.into_iter().flatten().any(|known| known.path == now.file.path) {
            Match::Same
        } else if holds_campaign && self.relative() == now.relative() {
            Match::MovedTogether
        } else if self.file.blake3 == now.file.blake3 && !file_exists(Path::new(&self.file.path)) {
            Match::Renamed
        } else {
            Match::Other
        }
    }

    /// The origin after a run with the configuration of `now`.
    pub fn continued(&self, now: &Self) -> Self {
        Self { began_with: self.began_with.clone(), ..now.clone() }
    }

    /// The origin after the `[label]` section of the configuration at `path`, which holds `text`, came into force.
    pub fn relabelled(self, path: &Path, text: &str) -> Self {
        Self { relabelled_by: Some(ConfigFile::new(&canonical(path), text)), ..self }
    }

    /// The configuration's path as seen from the campaign's directory: steps up, and the way down from there.
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
        Some(Component::Normal(parent)) if stem == COMMON_STEM => parent.to_string_lossy().into_owned(),
        _ => stem,
    }
}

fn canonical(path: &Path) -> PathBuf {
    path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn origin(path: &str, text: &str, directory: &str) -> Origin {
        Origin::new(Path::new(path), text, Path::new(directory))
    }

    #[test]
    fn a_campaign_is_called_after_its_configuration() {
        for (path, expected) in [
            ("/no/such/second/campaign.toml", "second"),
            ("/no/such/second/hot.toml", "hot"),
            ("/campaign.toml", "campaign"),
        ] {
            assert_eq!(origin(path, "", "/no/such").name, expected);
        }
    }

    #[test]
    fn another_file_is_no_configuration_of_the_campaign() {
        let first = origin("/no/first/campaign.toml", "a", "/no/first/campaign");
        let compare =
            |now: &Origin, holds_campaign, exists: bool| first.compare(now, holds_campaign, |_| exists);
        let second = origin("/no/second/campaign.toml", "a", "/no/first/campaign");
        assert_eq!(compare(&first, true, true), Match::Same);
        assert_eq!(compare(&second, true, true), Match::Other, "the content does not tell files apart");
        assert_eq!(compare(&second, true, false), Match::Renamed);
        let edited = origin("/no/second/campaign.toml", "b", "/no/first/campaign");
        assert_eq!(compare(&edited, true, false), Match::Other);
        let together = origin("/no/second/campaign.toml", "b", "/no/second/campaign");
        assert_eq!(compare(&together, true, true), Match::MovedTogether);
        assert_eq!(
            compare(&together, false, true),
            Match::Other,
            "a server holds the campaign of both copies"
        );
    }

    #[test]
    fn a_campaign_remembers_with_what_it_began() {
        let first = origin("/no/first/campaign.toml", "a", "/no/first/campaign");
        let now = first.continued(&origin("/no/second/hot.toml", "b", "/no/second/hot"));
        assert_eq!((now.name.as_str(), &now.began_with), ("hot", &first.file));
        assert_eq!(now.file.path, "/no/second/hot.toml");
        let relabelled = first.clone().relabelled(Path::new("/no/first/fine.toml"), "c");
        for path in ["/no/first/campaign.toml", "/no/first/fine.toml"] {
            let now = origin(path, "d", "/no/elsewhere");
            assert_eq!(relabelled.compare(&now, true, |_| true), Match::Same, "{path}");
            assert_eq!(relabelled.continued(&now).relabelled_by, None);
        }
    }
}
