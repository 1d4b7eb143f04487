//! `calmwalk relabel`

mod protocol_change;
mod selection;

use std::io::{self, Write};
use std::path::PathBuf;

use monitor::label_cost::{self, RelabelCost};
use monitor::provenance::Provenance;
use serde_json::{Value, json};
use store::{CampaignLock, Location, NewProtocol, Protocol, RelabelCounts, Store, unix_milliseconds};

use self::protocol_change::ProtocolChange;
use self::selection::Selection;
use super::campaign_location::shell_argument;
use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::filter::StructureFilter;
use crate::output::{count, print, print_json, warn_if_unencrypted};
use crate::wording;

/// Compute labels again, or switch the campaign to another label protocol
///
/// Queues the structures again, bypassing the label guard. Use it for doubtful or inaccurate labels. The old label stays valid until the
/// new one exists, and then stays in the store as superseded, with date and reason. If the new label fails, the old one stays valid.
/// Queues no structure twice.
///
/// With --config, switches the campaign to the label protocol of that file: structures without a label move to it, and calmwalk cancels
/// running calculations. The campaign must not be running, and the next `calmwalk run` needs that configuration.
#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("target").required(true).args(["ids", "all", "condition"]))]
pub struct RelabelArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Structures to relabel, also those labelled by the current protocol. Candidates: ids, unique prefixes of ids, or decision numbers;
    /// structures of `calmwalk import --queue`: import-N
    #[arg(value_name = "ID")]
    ids: Vec<String>,
    /// Relabel every structure whose label comes from another protocol than the current one
    #[arg(long)]
    all: bool,
    /// As --all, but only structures that match a filter, such as 'max_force > 20'; see `calmwalk export --help` for its syntax
    #[arg(long = "where", value_name = "FILTER")]
    condition: Option<StructureFilter>,
    /// With --all or --where: also relabel structures labelled by the current protocol
    #[arg(long)]
    include_current: bool,
    /// Configuration with the new label protocol in its [label] section; it needs a new name (label.protocol)
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Reason, stored with the labels
    #[arg(long, value_name = "TEXT", default_value = "none given")]
    reason: String,
    /// Print the number of structures and the expected cost without changing anything
    #[arg(long)]
    dry_run: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// What was changed, or would be in a dry run.
struct RelabelReport {
    /// The protocol of the new labels.
    protocol: Protocol,
    /// Its differences from the current protocol, one line each.
    changes: Vec<String>,
    selection: Selection,
    cost: RelabelCost,
    /// Numbers of structures.
    requeued: RelabelCounts,
    /// What the user does next.
    next: String,
}

impl RelabelArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let report = block_on(self.relabel())??;
        if self.json {
            print_json(&report.as_json(self.dry_run))?;
        } else {
            print(|out| report.write(out, self.dry_run, self.config.is_some()))?;
        }
        Ok(ExitStatus::Done)
    }

    async fn relabel(&self) -> Result<RelabelReport, CommandError> {
        let location = self.location.get()?;
        warn_if_unencrypted(&location);
        let store = match self.dry_run {
            true => Store::open_read_only(&location).await?,
            false => Store::open(&location).await?,
        };
        let none = || {
            CommandError::Input(
                "the campaign has no label protocol yet: start it with calmwalk run first".to_owned(),
            )
        };
        let in_force = store.protocol_in_force().await?.ok_or_else(none)?;
        let new = match &self.config {
            Some(path) => ProtocolChange::read(&store, path, &in_force).await?,
            None => None,
        };
        // Excludes a run: its labellers would keep the old protocol.
        let _lock = match new.is_some() && !self.dry_run {
            true => Some(CampaignLock::acquire_at(&location, "calmwalk relabel").await?),
            false => None,
        };
        let protocol = new.as_ref().map_or(&in_force, |new| &new.protocol).clone();
        let selection = self.select(&store, &protocol).await?;
        let moved =
            if new.is_some() { store.unlabelled_under_other_protocols(protocol.hash).await? } else { 0 };
        let cost = label_cost::relabel_cost(&store, &in_force, &selection.sizes()).await?;
        let next = self.next(&store, &location).await?;
        let mut requeued = RelabelCounts { relabelling: selection.structures().len() as u64, moved };
        if !self.dry_run {
            requeued = self.apply(&store, new.as_ref(), &selection).await?;
        }
        store.close().await;
        let changes = new.map_or(Vec::new(), |new| new.describe_changes());
        Ok(RelabelReport { protocol, changes, selection, cost, requeued, next })
    }

    /// How the labels will be computed.
    async fn next(&self, store: &Store, location: &Location) -> Result<String, CommandError> {
        if store.status().await?.run_active {
            return Ok("the campaign is running: its labellers compute the labels".to_owned());
        }
        let origin = Provenance::read(store).await?;
        let given = self.config.as_ref().map(|path| path.display().to_string());
        let config = given.or(origin.map(|origin| origin.file.path)).unwrap_or("CONFIG".to_owned());
        let directory = match location {
            Location::Directory(directory) => format!(" --directory {}", directory.display()),
            Location::Server(_) => String::new(),
        };
        Ok(format!(
            "next: compute the labels with calmwalk run {config}{directory}, or with calmwalk label --store {}",
            shell_argument(location)
        ))
    }

    async fn select(&self, store: &Store, protocol: &Protocol) -> Result<Selection, CommandError> {
        let all = store.relabellable(protocol.hash).await?;
        if !self.ids.is_empty() {
            return Selection::from_ids(store, all, &self.ids).await;
        }
        let all = match &self.condition {
            Some(condition) => selection::matching(store, all, condition).await?,
            None => all,
        };
        Ok(Selection::new(all, self.include_current))
    }

    async fn apply(
        &self,
        store: &Store,
        new: Option<&ProtocolChange>,
        selection: &Selection,
    ) -> Result<RelabelCounts, CommandError> {
        let changes: Vec<_> = new.iter().flat_map(|new| &new.changes).map(|change| change.detail()).collect();
        let protocol = new.map(|new| NewProtocol {
            protocol: &new.protocol,
            configuration: &new.configuration,
            changes: &changes,
            notes: &new.notes,
        });
        let (structures, include_current) =
            (selection.structures(), self.include_current || !self.ids.is_empty());
        let request = store::RelabelRequest {
            structures: &structures,
            include_current,
            reason: &self.reason,
            protocol,
        };
        Ok(store.relabel(&request, unix_milliseconds()).await?)
    }
}

impl RelabelReport {
    /// `has_config`: whether --config was given.
    fn write(&self, out: &mut dyn Write, dry_run: bool, has_config: bool) -> io::Result<()> {
        let Self { protocol: Protocol { name, .. }, changes, selection, cost, requeued, next } = self;
        let verb = |conditional: &'static str, indicative: &'static str| match dry_run {
            true => conditional,
            false => indicative,
        };
        changes.iter().try_for_each(|change| writeln!(out, "{change}"))?;
        if !changes.is_empty() {
            let (becomes, moved) = (verb("would become", "is now"), verb("would move", "moved"));
            writeln!(out, "protocol '{name}' {becomes} the current label protocol")?;
            writeln!(out, "{} without a label {moved} to it", count(requeued.moved, "structure"))?;
        } else if has_config {
            writeln!(out, "protocol '{name}' is already the current label protocol")?;
        }
        let are = verb("would be", if requeued.relabelling == 1 { "is" } else { "are" });
        let structures = count(requeued.relabelling, "structure");
        writeln!(out, "{structures} {are} queued again for protocol '{name}'{}", selection.replaced())?;
        selection.skipped(name).iter().try_for_each(|line| writeln!(out, "{line}"))?;
        if requeued.relabelling > 0 {
            writeln!(out, "cost: {}", wording::cost::relabel_cost(cost))?;
        }
        match dry_run {
            true => writeln!(out, "dry run: nothing was changed"),
            false if requeued.relabelling + requeued.moved > 0 => writeln!(out, "{next}"),
            false => Ok(()),
        }
    }

    fn as_json(&self, dry_run: bool) -> Value {
        let Self { protocol, changes, selection, cost, requeued, .. } = self;
        json!({
            "dry_run": dry_run, "protocol": protocol.name, "protocol_hash": protocol.hash.to_string(),
            "changes": changes, "relabelling": requeued.relabelling, "without_a_label": requeued.moved,
            "waiting_already": selection.waiting, "labelled_already": selection.labelled, "dropped": selection.dropped,
            "core_hours": cost.hours, "measured": cost.measured,
        })
    }
}
