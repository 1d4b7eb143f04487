//! The protocol of another configuration, in the place of the one in force.

use std::collections::BTreeSet;
use std::path::Path;

use atoms::Species;
use store::{Protocol, Store, StoreError};

use super::Failure;
use crate::config::{Change, Config, LabelSection, changed_keys};
use crate::label_setup::{self, LABEL_METHOD_KEY};
use crate::process_config::MethodConfig;
use crate::provenance::{self, Provenance};

/// How labels are made from now on.
pub struct NewLabels {
    /// By which protocol.
    pub protocol: Protocol,
    /// The configuration by which the campaign runs, JSON.
    pub configuration: String,
    /// How it differs from the one by which it ran.
    pub changes: Vec<Change>,
    /// What labellers on other hosts need to know.
    pub notes: Vec<(&'static str, String)>,
}

impl NewLabels {
    /// Reads the file's section, and finds what its method needs here; nothing if its protocol is the one in force.
    pub async fn of(store: &Store, path: &Path, in_force: &Protocol) -> Result<Option<Self>, Failure> {
        let section = Config::load_label(path)?;
        let method = MethodConfig::from_section(&section)?;
        let protocol = label_setup::protocol(section.protocol_name(), method.identity()?);
        if protocol.hash == in_force.hash {
            return Ok(None);
        }
        check_name(store, &protocol, path).await?;
        check_elements(store, &section, path).await?;
        let before = store.campaign().await?.configuration_in_force;
        let before = serde_json::from_str(&before)
            .map_err(|error| StoreError::damaged("the configuration in force", error))?;
        let after = label_setup::with_protocol(&before, &section, &protocol);
        let changed = changed_keys(&before, &after).into_iter();
        let changes = changed.map(|(key, before, after)| Change::Key { key, before, after }).collect();
        let note = serde_json::to_string(&method).map_err(Failure::failed)?;
        let mut notes = vec![(LABEL_METHOD_KEY, note)];
        notes.extend(origin_note(store, path).await?);
        Ok(Some(Self { protocol, configuration: after.to_string(), changes, notes }))
    }

    /// A line for each change.
    pub fn changes_in_words(&self) -> Vec<String> {
        self.changes.iter().map(ToString::to_string).collect()
    }
}

/// That the campaign may go on by this file.
async fn origin_note(store: &Store, path: &Path) -> Result<Option<(&'static str, String)>, Failure> {
    let Some(known) = Provenance::read(store).await? else { return Ok(None) };
    let text = std::fs::read_to_string(path)
        .map_err(|error| Failure::Input(format!("cannot read {}: {error}", path.display())))?;
    let note = serde_json::to_string(&known.relabelled(path, &text)).map_err(Failure::failed)?;
    Ok(Some((provenance::METADATA_KEY, note)))
}

/// A protocol has one name in a campaign, and a name means one protocol.
async fn check_name(store: &Store, protocol: &Protocol, path: &Path) -> Result<(), Failure> {
    let (path, name) = (path.display(), &protocol.name);
    for known in store.protocols().await? {
        if known.hash == protocol.hash && known.name != *name {
            return Err(Failure::Input(format!(
                "{path}: label.protocol is '{name}', but the campaign knows this protocol as '{}': give it that name",
                known.name
            )));
        }
        if known.hash != protocol.hash && known.name == *name {
            return Err(Failure::Input(format!(
                "{path}: label.protocol is '{name}', by which the campaign knows a protocol with other settings: give this one a \
                 name of its own, such as protocol = \"{name}-2\""
            )));
        }
    }
    Ok(())
}

/// Labels of every seed structure can be made by it.
async fn check_elements(store: &Store, section: &LabelSection, path: &Path) -> Result<(), Failure> {
    let seeds = store.seed_structures().await?;
    let species: BTreeSet<Species> =
        seeds.iter().flat_map(|seed| seed.structure.species.iter().copied()).collect();
    label_setup::supports(section, &species)
        .map_err(|error| Failure::Input(format!("{}: label.method: {error}", path.display())))
}
