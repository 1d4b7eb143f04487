//! The switch to the label protocol of another configuration.

use std::collections::BTreeSet;
use std::path::Path;

use atoms::Species;
use monitor::provenance::{self, Provenance};
use store::{Protocol, Store, StoreError};

use super::CommandError;
use crate::config::{Config, ConfigChange, LabelSection, changed_keys};
use crate::label_method::{self, MethodConfig};
use crate::label_setup::LABEL_METHOD_KEY;

/// The new label protocol, and what changes with it.
pub struct ProtocolChange {
    /// The new protocol.
    pub protocol: Protocol,
    /// The new configuration of the campaign, JSON.
    pub configuration: String,
    /// Its differences from the current configuration.
    pub changes: Vec<ConfigChange>,
    /// Metadata for labellers on other hosts.
    pub notes: Vec<(&'static str, String)>,
}

impl ProtocolChange {
    /// Reads the [label] section of a file and loads its method on this host. `None` if its protocol is the current one.
    pub async fn read(store: &Store, path: &Path, in_force: &Protocol) -> Result<Option<Self>, CommandError> {
        let section = Config::load_label(path)?;
        let method = MethodConfig::from_section(&section)?;
        let protocol = label_method::protocol(section.protocol_name(), method.identity()?);
        if protocol.hash == in_force.hash {
            return Ok(None);
        }
        check_name(store, &protocol, path).await?;
        check_elements(store, &section, path).await?;
        let before = store.campaign().await?.configuration_in_force;
        let before = serde_json::from_str(&before)
            .map_err(|error| StoreError::damaged("the configuration in force", error))?;
        let after = label_method::with_protocol(&before, &section, &protocol);
        let changed = changed_keys(&before, &after).into_iter();
        let changes = changed.map(|(key, before, after)| ConfigChange::Key { key, before, after }).collect();
        let note = serde_json::to_string(&method).map_err(CommandError::failed)?;
        let mut notes = vec![(LABEL_METHOD_KEY, note)];
        notes.extend(origin_note(store, path).await?);
        Ok(Some(Self { protocol, configuration: after.to_string(), changes, notes }))
    }

    /// One line per change.
    pub fn describe_changes(&self) -> Vec<String> {
        self.changes.iter().map(ToString::to_string).collect()
    }
}

/// The record that lets the campaign resume with this file.
async fn origin_note(store: &Store, path: &Path) -> Result<Option<(&'static str, String)>, CommandError> {
    let Some(known) = Provenance::read(store).await? else { return Ok(None) };
    let text = std::fs::read_to_string(path)
        .map_err(|error| CommandError::Input(format!("cannot read {}: {error}", path.display())))?;
    let note = serde_json::to_string(&known.relabelled(path, &text)).map_err(CommandError::failed)?;
    Ok(Some((provenance::METADATA_KEY, note)))
}

/// Checks that names and protocols correspond one to one in the campaign.
async fn check_name(store: &Store, protocol: &Protocol, path: &Path) -> Result<(), CommandError> {
    let (path, name) = (path.display(), &protocol.name);
    for known in store.protocols().await? {
        if known.hash == protocol.hash && known.name != *name {
            return Err(CommandError::Input(format!(
                "{path}: label.protocol is '{name}', but in this campaign the same protocol is named '{}': use that name",
                known.name
            )));
        }
        if known.hash != protocol.hash && known.name == *name {
            return Err(CommandError::Input(format!(
                "{path}: label.protocol is '{name}', but in this campaign '{name}' is a protocol with other settings: choose a new \
                 name, such as protocol = \"{name}-2\""
            )));
        }
    }
    Ok(())
}

/// Checks that the method supports the elements of all seed structures.
async fn check_elements(store: &Store, section: &LabelSection, path: &Path) -> Result<(), CommandError> {
    let seeds = store.seed_structures().await?;
    let species: BTreeSet<Species> =
        seeds.iter().flat_map(|seed| seed.structure.species.iter().copied()).collect();
    label_method::supports(section, &species)
        .map_err(|error| CommandError::Input(format!("{}: label.method: {error}", path.display())))
}
