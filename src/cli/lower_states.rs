//! `calmwalk lower-states`

use std::io::{self, Write};

use store::{LowerState, LowerStateChange, StateResult, Store, unix_milliseconds};

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::{TextTable, decimals, print, print_json, warn_if_unencrypted};

/// List labels for which a lower magnetic state is known, or replace them by it
///
/// A calculation may converge to another magnetic state, above all after a failure, when it starts from other initial moments. Lists a
/// structure if another valid result by the same label protocol is lower in energy than its label by more than
/// label.min_state_difference. Ignores excluded results.
///
/// With IDs or --all, makes the lowest result the label of each structure. The old label stays in the store as superseded, with date and
/// reason. Works while the campaign runs. Changes either all given structures or none.
#[derive(Debug, clap::Args)]
pub struct LowerStatesArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Structures to change. Candidates: ids, unique prefixes of ids, or decision numbers; or imported structures, such as import-3
    #[arg(value_name = "ID")]
    ids: Vec<String>,
    /// Change every listed structure
    #[arg(long, conflicts_with = "ids")]
    all: bool,
    /// Remark, stored with the reason of the superseded labels; needs IDs or --all
    #[arg(long, value_name = "TEXT")]
    reason: Option<String>,
    /// Only show what IDs or --all would change
    #[arg(long)]
    dry_run: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl LowerStatesArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        if self.all || !self.ids.is_empty() {
            let changes = block_on(self.take())??;
            if self.json {
                print_json(&changes)?
            } else {
                print(|out| write_changes(out, &changes, self.dry_run))?
            }
            return Ok(ExitStatus::Done);
        }
        let useless = [("--reason", self.reason.is_some()), ("--dry-run", self.dry_run)];
        if let Some((option, _)) = useless.into_iter().find(|(_, is_given)| *is_given) {
            let message = format!("{option} needs IDs or --all: without them, nothing is changed");
            return Err(CommandError::Input(message));
        }
        let states = block_on(self.read())??;
        if self.json {
            print_json(&states)?
        } else {
            print(|out| write_list(out, &states))?
        }
        Ok(ExitStatus::Done)
    }

    async fn read(&self) -> Result<Vec<LowerState>, CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let states = store.lower_states().await?;
        store.close().await;
        Ok(states)
    }

    async fn take(&self) -> Result<Vec<LowerStateChange>, CommandError> {
        let location = self.location.get()?;
        let ids = (!self.all).then_some(self.ids.as_slice());
        if self.dry_run {
            let store = Store::open_read_only(&location).await?;
            let changes = store.lower_state_changes(ids).await?;
            store.close().await;
            return Ok(changes);
        }
        warn_if_unencrypted(&location);
        let store = Store::open(&location).await?;
        let reason = self.reason.as_deref().map(str::trim).filter(|reason| !reason.is_empty());
        let changes = store.take_lower_states(ids, reason, unix_milliseconds()).await?;
        store.close().await;
        Ok(changes)
    }
}

fn write_list(out: &mut dyn Write, states: &[LowerState]) -> io::Result<()> {
    if states.is_empty() {
        return writeln!(out, "every label is the lowest known state of its structure");
    }
    let mut table = TextTable::new(&[
        "id",
        "result",
        ">energy (eV/atom)",
        ">difference",
        ">magnetisation (μ_B)",
        "initial moments",
        "protocol",
        "from",
    ]);
    for state in states {
        let mut push = |id: &str, result: &str, difference: String, found: &StateResult| {
            let moments = if found.changed_moments { "changed" } else { "as the protocol" };
            table.push(vec![
                id.to_owned(),
                result.to_owned(),
                format!("{:.6}", found.energy_per_atom),
                difference,
                decimals(found.magnetisation, 4),
                moments.to_owned(),
                state.protocol.clone(),
                found.source.clone(),
            ]);
        };
        push(&state.id, "label", String::new(), &state.label);
        push("", "lower", format!("{:.6}", state.difference_per_atom), &state.lower);
    }
    table.write(out)
}

fn write_changes(out: &mut dyn Write, changes: &[LowerStateChange], dry_run: bool) -> io::Result<()> {
    if changes.is_empty() {
        return writeln!(out, "every label is the lowest known state of its structure: nothing was changed");
    }
    for LowerStateChange { id, taken } in changes {
        for LowerState { protocol, difference_per_atom, lower, .. } in taken {
            let source = &lower.source;
            let (is, then) = match dry_run {
                true => ("would be", "nothing was changed"),
                false => ("is now", "the label before is superseded"),
            };
            writeln!(
                out,
                "{id}: label of '{protocol}' {is} the result of {source}, lower by {:.6} eV/atom; {then}",
                -difference_per_atom
            )?;
        }
        if taken.is_empty() {
            writeln!(out, "{id}: its label is the lowest known state; nothing was changed")?;
        }
    }
    Ok(())
}
