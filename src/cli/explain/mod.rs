//! `calmwalk explain`

mod decision;
mod grades;
mod labels;

use std::io::{self, Write};

use monitor::calibration::{ExpectedErrors, expected_errors};
use monitor::candidate_details::{
    self, CandidateDetails, Discovery, GuardDistances, GuardPairDistance, StructureSummary,
};
use store::{Location, Store};

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::{count, decimals, print, print_json};
use crate::wording;

/// Indent of lines without a title.
const INDENT: &str = "             ";
/// Entries of a list that are printed.
const SHOWN: usize = 20;

/// Show the full history of one candidate
///
/// Shows
///
/// - the atoms that triggered it, and its grades under the walker's, the selector's and the original mixture;
///
/// - the decision with its rule and numbers, every value of α that the update tried, and the later candidates that it covered;
///
/// - the attempts at its label with their costs;
///
/// - the error of the potential beside the one expected from earlier labels.
///
/// For control frames and imported structures, shows what is recorded. Works while the campaign runs and on backups.
#[derive(Debug, clap::Args)]
pub struct ExplainArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Id of a candidate or a unique prefix of it (you may omit the campaign part), number of its decision, or import-N for an imported
    /// structure
    id: String,
    /// Print JSON, with the grades of every atom (docs/explain.md)
    #[arg(long)]
    json: bool,
    /// Also print the logs of attempts that made a label
    #[arg(long)]
    all: bool,
}

impl ExplainArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let (details, expected) = block_on(read(self.location.get()?, &self.id))??;
        if self.json {
            let mut json = wording::json::candidate(&details).map_err(CommandError::failed)?;
            json["expected_errors"] = serde_json::to_value(&expected).map_err(CommandError::failed)?;
            print_json(&json)?
        } else {
            print(|out| write(out, &details, expected.as_ref(), self.all))?
        }
        Ok(ExitStatus::Done)
    }
}

/// The output of the command.
pub async fn text(location: Location, id: &str) -> Result<String, CommandError> {
    let (mut text, (details, expected)) = (Vec::new(), read(location, id).await?);
    write(&mut text, &details, expected.as_ref(), false).map_err(CommandError::failed)?;
    Ok(String::from_utf8_lossy(&text).into_owned())
}

async fn read(
    location: Location,
    id: &str,
) -> Result<(CandidateDetails, Option<ExpectedErrors>), CommandError> {
    let store = Store::open_read_only(&location).await?;
    let details = candidate_details::read(&store, id).await?;
    let expected = expected_errors(&store, &details).await?;
    store.close().await;
    Ok((details, expected))
}

fn write(
    out: &mut dyn Write,
    details: &CandidateDetails,
    expected: Option<&ExpectedErrors>,
    all: bool,
) -> io::Result<()> {
    writeln!(out, "{}", details.id)?;
    write_structure(out, &details.structure)?;
    if let (Some(file), Some(frame)) = (&details.file, details.frame) {
        line(out, "from", &format!("{file}, frame {frame}: imported with its label"))?;
    }
    if let Some(found) = &details.found {
        write_found(out, found)?;
    }
    if let Some(grades) = &details.grades {
        grades::write(out, grades)?;
    }
    if let (Some(found), Some(decision)) = (&details.found, &details.decision) {
        write_distances(out, &found.distances)?;
        decision::write(out, decision, details.structure.atoms)?;
    }
    write_same(out, details)?;
    labels::write(out, details, all)?;
    let expected = expected.map(wording::calibration::expected).unwrap_or_default();
    for (k, text) in expected.iter().enumerate() {
        line(out, if k == 0 { "expected" } else { "" }, text)?;
    }
    for (k, what) in details.not_recorded.iter().enumerate() {
        line(out, if k == 0 { "not recorded" } else { "" }, what)?;
    }
    Ok(())
}

/// A line with a title.
fn line(out: &mut dyn Write, title: &str, text: &str) -> io::Result<()> {
    writeln!(out, "{title:<12} {text}")
}

/// A comma-separated list of at most [`SHOWN`] names.
fn shortened_list<T: AsRef<str>>(names: impl ExactSizeIterator<Item = T>) -> String {
    let more = names.len().saturating_sub(SHOWN);
    let mut shown: Vec<_> = names.take(SHOWN).map(|name| name.as_ref().to_owned()).collect();
    if more > 0 {
        shown.push(format!("… and {more} more (use --json)"));
    }
    shown.join(", ")
}

fn write_structure(out: &mut dyn Write, structure: &StructureSummary) -> io::Result<()> {
    let StructureSummary { formula, atoms, volume, fragments, hash, .. } = structure;
    let volume = volume
        .map_or(String::new(), |volume| format!(", {volume:.2} Å³ ({:.3} Å³/atom)", volume / *atoms as f64));
    let fragments = fragments.map_or(String::new(), |number| format!(", {}", count(number, "fragment")));
    let atoms = count(*atoms, "atom");
    line(out, "structure", &format!("{formula}, {atoms}{volume}{fragments}; content {}", &hash[..16]))
}

fn write_found(out: &mut dyn Write, found: &Discovery) -> io::Result<()> {
    let Discovery { walk, segment, step, seed_structure_name, temperature, relative_volume, .. } = found;
    line(
        out,
        "from",
        &format!(
            "walk {walk} of seed structure '{seed_structure_name}', segment {segment}, step {step}: {temperature:.0} K, \
             V/V₀ {relative_volume:.4}"
        ),
    )?;
    if found.version > 0 {
        let version = found.version;
        line(
            out,
            "",
            &format!("with version {version} of the potential, which its energy and grades are of"),
        )?;
    }
    if let Some(biased) = found.control_of {
        let partner = found.partner.as_ref().map_or_else(
            || "which had no accepted candidate at this step".to_owned(),
            |named| format!("whose candidate at this step is {}", named.candidate),
        );
        line(
            out,
            "",
            &format!("a control walk: unbiased, with the random numbers of walk {biased}, {partner}"),
        )?;
    }
    if let Some(point) = &found.trace_point {
        line(out, "", &wording::walk_trace::sentence(point))?;
    }
    let Some(walk) = &found.walk_now else { return Ok(()) };
    let reason = if walk.reason.is_empty() { String::new() } else { format!(" ({})", walk.reason) };
    // Control walks offer frames at requested steps, on which only the selector's guard decides, and never roll back.
    let guard = match found.control_of {
        Some(_) => String::new(),
        None => format!(
            "; its guard rejected {}, it rolled back {}",
            count(walk.rejected, "structure"),
            count(walk.rollbacks, "time")
        ),
    };
    let (state, step, accepted) = (walk.state.replace('_', " "), walk.step, walk.accepted);
    line(
        out,
        "",
        &format!("current state of the walk: {state}{reason}, step {step}, {accepted} accepted{guard}"),
    )
}

fn write_distances(out: &mut dyn Write, distances: &GuardDistances) -> io::Result<()> {
    let GuardDistances { shortest, atoms, pairs } = distances;
    let pair = atoms.map_or(String::new(), |[i, j]| format!(" (atoms {i} and {j})"));
    line(out, "guard", &format!("shortest distance {} Å{pair}", decimals(*shortest, 3)))?;
    for GuardPairDistance { pair, shortest, seed_structure, limit } in pairs {
        let Some(limit) = limit else { continue };
        let position = if shortest < limit { "below" } else { "at least" };
        let seed = decimals(*seed_structure, 3);
        let text = format!(
            "{pair}: {shortest:.3} Å, {position} the selector's limit of {limit:.3} Å (seed structure: {seed} Å)"
        );
        line(out, "", &text)?;
    }
    Ok(())
}

fn write_same(out: &mut dyn Write, details: &CandidateDetails) -> io::Result<()> {
    if !details.same_structure.is_empty() {
        let names = details.same_structure.iter().map(|named| &named.candidate);
        line(out, "the same as", &shortened_list(names))?;
    }
    match details.same_import {
        Some(import) => line(out, "the same as", &format!("import-{import}")),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_version_of_the_walk_is_named_unless_it_is_that_of_the_configuration() {
        let text = |version| {
            let found = Discovery {
                walk: 3,
                version,
                segment: 0,
                step: 100,
                seed_structure: 0,
                seed_structure_name: "fcc".into(),
                temperature: 300.0,
                relative_volume: 1.0,
                energy: -1.0,
                control_of: None,
                partner: None,
                distances: GuardDistances { shortest: None, atoms: None, pairs: Vec::new() },
                trace_point: None,
                walk_now: None,
            };
            let mut out = Vec::new();
            write_found(&mut out, &found).unwrap();
            String::from_utf8(out).unwrap()
        };
        assert!(text(2).contains("with version 2 of the potential"), "{}", text(2));
        assert!(!text(0).contains("version"), "{}", text(0));
    }
}
