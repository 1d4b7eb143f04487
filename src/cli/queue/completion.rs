//! `calmwalk queue DIR completion`

use std::io::{self, Write};

use monitor::completion_model::{CompletionReport, MIN_FINISHED, MIN_OF_EACH};
use store::{Location, Store};

use crate::cli::CommandError;
use crate::output::{TextTable, decimals};

/// The model of the newest version of the potential that walks have; `None` before the first finished label.
pub async fn read(location: &Location) -> Result<Option<CompletionReport>, CommandError> {
    let store = Store::open_read_only(location).await?;
    let Some(protocol) = store.protocol_in_force().await? else { return Ok(None) };
    let version = store.walk_versions().await?.newest();
    Ok(CompletionReport::read(&store, protocol.hash, version).await?)
}

pub fn write(out: &mut dyn Write, found: Option<&CompletionReport>) -> io::Result<()> {
    let Some(found) = found else { return writeln!(out, "no label is finished yet") };
    let CompletionReport { version, finished, failed, brier_score, brier_score_of_share, .. } = found;
    let of = match found.of_all_versions {
        true => format!("all versions of the potential, without γ, since version {version} has too few"),
        false => format!("version {version} of the potential"),
    };
    writeln!(out, "{finished} finished labels of {of}; {failed} of them failed")?;
    if found.is_regression {
        let mut table = TextTable::new(&["predictor", ">coefficient"]);
        for (name, value) in &found.coefficients {
            table.push(vec![name.clone(), decimals(Some(*value), 3)]);
        }
        table.write(out)?;
    } else {
        writeln!(
            out,
            "too few to learn from ({MIN_FINISHED} finished, {MIN_OF_EACH} labelled and {MIN_OF_EACH} failed ones are needed): \
             every label completes with the same probability"
        )?;
    }
    let mut table = TextTable::new(&["predicted", ">structures", ">mean", ">completed", "95 % interval"]);
    for bin in &found.reliability {
        table.push(vec![
            format!("{} to {}", decimals(Some(bin.from), 1), decimals(Some(bin.to), 1)),
            bin.structures.to_string(),
            decimals(bin.predicted, 3),
            decimals(bin.observed, 3),
            format!("{} to {}", decimals(bin.low, 3), decimals(bin.high, 3)),
        ]);
    }
    table.write(out)?;
    writeln!(
        out,
        "Brier score {}, of the share that completes {}; each structure is predicted from those of other seed structures, or \
         walks with fewer than five of these",
        decimals(*brier_score, 4),
        decimals(*brier_score_of_share, 4)
    )
}
