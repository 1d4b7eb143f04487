//! `calmwalk explain`

mod decision;
mod grades;
mod labels;

use std::io::{self, Write};

use store::{Location, Store};

use super::{CampaignLocation, ExitStatus, Failure, block_on};
use crate::candidate_details::{self, CandidateDetails, Discovery, Distances, StructureSummary};
use crate::output::{count, decimals, print, print_json};

/// Columns of a line before its text.
const INDENT: &str = "             ";
/// Entries of a list that are shown.
const SHOWN: usize = 20;

/// Tell the whole story of one candidate
///
/// Which atoms made it a candidate, its grades under the walker's, the selector's and the original mixture, the decision
/// with its rule and numbers, every α that was tried, what became of its label and what each attempt cost, how far the
/// potential is from the label, and which later candidates it covered. Of controls and imported structures what there is.
/// Works while the campaign runs, and on a copy.
#[derive(Debug, clap::Args)]
pub struct Explain {
    #[command(flatten)]
    location: CampaignLocation,
    /// Candidate: its name or the beginning of it (the campaign's part may be left out), the number of the decision about it,
    /// or import-N for an imported structure
    id: String,
    /// Print JSON (docs/explain.md), with every atom
    #[arg(long)]
    json: bool,
}

impl Explain {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let story = block_on(read(self.location.get()?, &self.id))??;
        if self.json {
            print_json(&story)?
        } else {
            print(|out| write(out, &story))?
        }
        Ok(ExitStatus::Done)
    }
}

/// All that the command prints.
pub async fn text(location: Location, id: &str) -> Result<String, Failure> {
    let (mut text, story) = (Vec::new(), read(location, id).await?);
    write(&mut text, &story).map_err(Failure::failed)?;
    Ok(String::from_utf8_lossy(&text).into_owned())
}

async fn read(location: Location, id: &str) -> Result<CandidateDetails, Failure> {
    let store = Store::open_read_only(&location).await?;
    let story = candidate_details::read(&store, id).await?;
    store.close().await;
    Ok(story)
}

fn write(out: &mut dyn Write, story: &CandidateDetails) -> io::Result<()> {
    writeln!(out, "{}", story.id)?;
    write_structure(out, &story.structure)?;
    if let (Some(file), Some(frame)) = (&story.file, story.frame) {
        line(out, "from", &format!("{file}, frame {frame}: imported with its label"))?;
    }
    if let Some(found) = &story.found {
        write_found(out, found)?;
    }
    if let Some(grades) = &story.grades {
        grades::write(out, grades)?;
    }
    if let (Some(found), Some(decision)) = (&story.found, &story.decision) {
        write_distances(out, &found.distances, decision.kind == "control")?;
        decision::write(out, decision, story.structure.atoms)?;
    }
    write_same(out, story)?;
    labels::write(out, story)?;
    for (k, what) in story.not_recorded.iter().enumerate() {
        line(out, if k == 0 { "not recorded" } else { "" }, what)?;
    }
    Ok(())
}

/// A line with its title.
fn line(out: &mut dyn Write, title: &str, text: &str) -> io::Result<()> {
    writeln!(out, "{title:<12} {text}")
}

/// A list, of which only the beginning is shown.
fn first<T: AsRef<str>>(names: impl ExactSizeIterator<Item = T>) -> String {
    let more = names.len().saturating_sub(SHOWN);
    let mut shown: Vec<_> = names.take(SHOWN).map(|name| name.as_ref().to_owned()).collect();
    if more > 0 {
        shown.push(format!("… and {more} more (--json has all)"));
    }
    shown.join(", ")
}

fn write_structure(out: &mut dyn Write, structure: &StructureSummary) -> io::Result<()> {
    let StructureSummary { formula, atoms, volume, hash, .. } = structure;
    let volume = volume.map_or(String::new(), |volume| {
        format!(", {volume:.2} Å³ ({:.3} Å³ an atom)", volume / *atoms as f64)
    });
    line(out, "structure", &format!("{formula}, {}{volume}; content {}", count(*atoms, "atom"), &hash[..16]))
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
    if let Some(biased) = found.control_of {
        let partner = found.partner.as_ref().map_or_else(
            || "nothing of it was accepted at this step".to_owned(),
            |named| format!("its candidate at this step is {}", named.candidate),
        );
        line(out, "", &format!("a control: unbiased, with the random numbers of walk {biased}; {partner}"))?;
    }
    let Some(walk) = &found.walk_now else { return Ok(()) };
    let reason = if walk.reason.is_empty() { String::new() } else { format!(" ({})", walk.reason) };
    // A control gives frames of steps that are wanted: no guard refuses them, and it never goes back.
    let guard = match found.control_of {
        Some(_) => String::new(),
        None => format!(
            "; its own guard refused {}, it went back {}",
            count(walk.refused, "structure"),
            count(walk.returns, "time")
        ),
    };
    let (state, step, accepted) = (walk.state.replace('_', " "), walk.step, walk.accepted);
    line(out, "", &format!("the walk by now: {state}{reason}, step {step}, {accepted} accepted{guard}"))
}

fn write_distances(out: &mut dyn Write, distances: &Distances, control: bool) -> io::Result<()> {
    let Distances { shortest, atoms, seed_structure, least } = distances;
    let pair = atoms.map_or(String::new(), |[i, j]| format!(" (atoms {i} and {j})"));
    let found = format!("shortest distance {} Å{pair}", decimals(*shortest, 3));
    let judged = match (control, shortest, least) {
        (true, ..) => "; frames of controls are held to no limit".to_owned(),
        (false, Some(shortest), Some(least)) => format!(
            ", {} {least:.3} Å, the selector's limit (seed structure {} Å)",
            if shortest < least { "below" } else { "at least" },
            decimals(*seed_structure, 3)
        ),
        _ => String::new(),
    };
    line(out, "guard", &(found + &judged))
}

fn write_same(out: &mut dyn Write, story: &CandidateDetails) -> io::Result<()> {
    if !story.same_structure.is_empty() {
        let names = story.same_structure.iter().map(|named| &named.candidate);
        line(out, "the same as", &first(names))?;
    }
    match story.same_import {
        Some(import) => line(out, "the same as", &format!("import-{import}")),
        None => Ok(()),
    }
}
