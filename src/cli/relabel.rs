//! `calmwalk relabel`

mod choice;
mod protocol;

use std::io::{self, Write};
use std::path::PathBuf;

use serde_json::{Value, json};
use store::{CampaignLock, Location, NewProtocol, Protocol, RelabelCounts, Store, unix_milliseconds};

use self::choice::Choice;
use self::protocol::NewLabels;
use super::place::shown;
use super::{CampaignLocation, Ended, Failure, block_on};
use crate::bill::{self, Again};
use crate::condition::Condition;
use crate::origin::Origin;
use crate::output::{count, print, print_json, say_if_unprotected};

/// Label structures again, and change the protocol by which a campaign labels
///
/// For labels that turned out doubtful, or not good enough. The structures are put into the queue again, past any guard; a label
/// stays the label until the new one has come, and is kept beside it then as superseded, with date and reason. Where the new one
/// cannot be made, nothing has changed. What waits already is not asked for twice.
///
/// With --config they are labelled by the protocol of that file's [label] section, which is the campaign's from then on: what has no
/// label yet goes over to it, and calculations under way are given up. Not while the campaign runs; the next calmwalk run has to be
/// given that configuration.
#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("which").required(true).args(["ids", "all", "condition"]))]
pub struct Relabel {
    #[command(flatten)]
    location: CampaignLocation,
    /// Candidates, by their ids, the beginning of these or the number of the decision; also if they have their labels by the
    /// protocol in force
    #[arg(value_name = "ID")]
    ids: Vec<String>,
    /// Every structure that has its label by another protocol than the one in force
    #[arg(long)]
    all: bool,
    /// Of these, the ones that meet a condition as export has them, such as 'max_force > 20'
    #[arg(long = "where", value_name = "CONDITION")]
    condition: Option<Condition>,
    /// With --all or --where: also those that have their labels by the protocol in force
    #[arg(long)]
    again: bool,
    /// A configuration whose [label] section has another protocol, with a name of its own (label.protocol)
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Why, for those who look at the labels later
    #[arg(long, value_name = "TEXT", default_value = "none given")]
    reason: String,
    /// Only say how many there are, and what they may cost
    #[arg(long)]
    dry_run: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// What was asked for, and what came of it.
struct Order {
    /// By which they are labelled.
    protocol: Protocol,
    /// What makes it another than the one in force, a line each.
    changes: Vec<String>,
    choice: Choice,
    bill: Again,
    /// `moved` is known before.
    done: RelabelCounts,
    /// How the labels come to be made.
    next: String,
}

impl Relabel {
    pub fn run(self) -> Result<Ended, Failure> {
        let order = block_on(self.relabel())??;
        if self.json {
            print_json(&order.as_json(self.dry_run))?;
        } else {
            print(|out| order.write(out, self.dry_run, self.config.is_some()))?;
        }
        Ok(Ended::Done)
    }

    async fn relabel(&self) -> Result<Order, Failure> {
        let location = self.location.get()?;
        say_if_unprotected(&location);
        let store = match self.dry_run {
            true => Store::open_read_only(&location).await?,
            false => Store::open(&location).await?,
        };
        let none = || Failure::Input("the campaign has no label protocol yet: run it first".to_owned());
        let in_force = store.protocol_in_force().await?.ok_or_else(none)?;
        let new = match &self.config {
            Some(path) => NewLabels::of(&store, path, &in_force).await?,
            None => None,
        };
        // Labellers by two protocols at once would not know of each other.
        let _lock = match new.is_some() && !self.dry_run {
            true => Some(CampaignLock::acquire_at(&location, "calmwalk relabel").await?),
            false => None,
        };
        let protocol = new.as_ref().map_or(&in_force, |new| &new.protocol).clone();
        let choice = self.choose(&store, &protocol).await?;
        let moved =
            if new.is_some() { store.unlabelled_under_other_protocols(protocol.hash).await? } else { 0 };
        let bill = bill::again(&store, &in_force, &choice.sizes()).await?;
        let next = self.next(&store, &location).await?;
        let mut done = RelabelCounts { again: choice.structures().len() as u64, moved };
        if !self.dry_run {
            done = self.carry_out(&store, new.as_ref(), &choice).await?;
        }
        store.close().await;
        let changes = new.map_or(Vec::new(), |new| new.changes_in_words());
        Ok(Order { protocol, changes, choice, bill, done, next })
    }

    /// What has to be done for the labels to be made.
    async fn next(&self, store: &Store, location: &Location) -> Result<String, Failure> {
        if store.status().await?.led {
            return Ok("the campaign runs: its labellers take them".to_owned());
        }
        let origin = Origin::of(store).await?;
        let given = self.config.as_ref().map(|path| path.display().to_string());
        let config = given.or(origin.map(|origin| origin.file.path)).unwrap_or("CONFIG".to_owned());
        let directory = match location {
            Location::Directory(directory) => format!(" --directory {}", directory.display()),
            Location::Server(_) => String::new(),
        };
        Ok(format!(
            "next: calmwalk run {config}{directory} makes the labels, or calmwalk label --store {}",
            shown(location)
        ))
    }

    async fn choose(&self, store: &Store, protocol: &Protocol) -> Result<Choice, Failure> {
        let all = store.relabellable(protocol.hash).await?;
        if !self.ids.is_empty() {
            return Choice::named(store, all, &self.ids).await;
        }
        let all = match &self.condition {
            Some(condition) => choice::meeting(store, all, condition).await?,
            None => all,
        };
        Ok(Choice::of(all, self.again))
    }

    async fn carry_out(
        &self,
        store: &Store,
        new: Option<&NewLabels>,
        choice: &Choice,
    ) -> Result<RelabelCounts, Failure> {
        let changes: Vec<_> = new.iter().flat_map(|new| &new.changes).map(|change| change.detail()).collect();
        let protocol = new.map(|new| NewProtocol {
            protocol: &new.protocol,
            configuration: &new.configuration,
            changes: &changes,
            notes: &new.notes,
        });
        let (structures, again) = (choice.structures(), self.again || !self.ids.is_empty());
        let order = store::RelabelRequest { structures: &structures, again, reason: &self.reason, protocol };
        Ok(store.relabel(&order, unix_milliseconds()).await?)
    }
}

impl Order {
    fn write(&self, out: &mut dyn Write, dry_run: bool, is_given: bool) -> io::Result<()> {
        let Self { protocol: Protocol { name, .. }, changes, choice, bill, done, next } = self;
        let will = |is: &'static str, was: &'static str| if dry_run { is } else { was };
        changes.iter().try_for_each(|change| writeln!(out, "{change}"))?;
        if !changes.is_empty() {
            let (comes, goes) = (will("would come", "is"), will("would go", "went"));
            writeln!(out, "protocol '{name}' {comes} in force")?;
            writeln!(out, "{} without a label {goes} over to it", count(done.moved, "structure"))?;
        } else if is_given {
            writeln!(out, "protocol '{name}' is in force already")?;
        }
        let are = will("would be", if done.again == 1 { "is" } else { "are" });
        let structures = count(done.again, "structure");
        writeln!(out, "{structures} {are} queued to be labelled again by protocol '{name}'{}", choice.by())?;
        choice.left_alone(name).iter().try_for_each(|line| writeln!(out, "{line}"))?;
        if done.again > 0 {
            writeln!(out, "cost: {bill}")?;
        }
        match dry_run {
            true => writeln!(out, "nothing was changed"),
            false if done.again + done.moved > 0 => writeln!(out, "{next}"),
            false => Ok(()),
        }
    }

    fn as_json(&self, dry_run: bool) -> Value {
        let Self { protocol, changes, choice, bill, done, .. } = self;
        json!({
            "dry_run": dry_run, "protocol": protocol.name, "protocol_hash": protocol.hash.to_string(),
            "changes": changes, "again": done.again, "without_a_label": done.moved,
            "waiting_already": choice.waiting, "labelled_already": choice.labelled, "dropped": choice.dropped,
            "core_hours": bill.hours, "measured": bill.measured,
        })
    }
}
