//! `calmwalk versions … compare`

use std::io::{self, Write};

use serde_json::{Value, json};
use store::{Location, VersionRecord};

use super::errors::{ErrorPair, errors_of, of_both, table};
use super::{CommandError, ExitStatus};
use crate::output::{print, print_json};

/// Compare the errors of two versions
///
/// Compares them on the data sets on which both were judged. If one is version 0 or the parent of the other, the refit evaluated both
/// on the same structures. Otherwise, leaves out sets that have grown in between, such as the held-out labels.
#[derive(Debug, clap::Args)]
pub struct VersionsCompareArgs {
    /// Number of a version; 0 is the potential of the configuration
    #[arg(value_name = "A")]
    one: u32,
    /// Number of the other version
    #[arg(value_name = "B")]
    other: u32,
}

impl VersionsCompareArgs {
    pub fn run(self, location: &Location, json: bool) -> Result<ExitStatus, CommandError> {
        let versions = super::read(location, async |store| Ok(store.versions().await?))?;
        let numbers = [self.one, self.other];
        for number in numbers.into_iter().filter(|number| *number > 0) {
            super::numbered(&versions, number)?;
        }
        let pairs = of_both(&versions, numbers);
        if json {
            print_json(&to_json(numbers, &versions, &pairs))?;
        } else {
            print(|out| write(out, numbers, &versions, &pairs))?;
        }
        Ok(ExitStatus::Done)
    }
}

/// Names of data sets that only one of the versions was judged by, for each.
fn only_in<'a>(
    numbers: [u32; 2],
    versions: &'a [VersionRecord],
    pairs: &[ErrorPair<'_>],
) -> [Vec<&'a str>; 2] {
    numbers.map(|number| {
        let sets = errors_of(versions, number).into_iter().map(|found| found.set);
        sets.filter(|set| pairs.iter().all(|pair| pair.set != *set)).collect()
    })
}

fn write(
    out: &mut dyn Write,
    numbers: [u32; 2],
    versions: &[VersionRecord],
    pairs: &[ErrorPair<'_>],
) -> io::Result<()> {
    let [one, other] = numbers.map(|number| format!("version {number}"));
    if pairs.is_empty() {
        writeln!(out, "the two versions have no data set in common")?;
    } else {
        table([&one, &other], pairs).write(out)?;
    }
    for ErrorPair { set, structures, .. } in pairs.iter().filter(|pair| !pair.is_comparable()) {
        let [first, second] = structures;
        writeln!(
            out,
            "{set}: {one} was judged by {first} structures and {other} by {second}, so their errors are not compared"
        )?;
    }
    for (name, sets) in [&one, &other].into_iter().zip(only_in(numbers, versions, pairs)) {
        if !sets.is_empty() {
            writeln!(out, "only {name} was judged on: {}", sets.join(", "))?;
        }
    }
    Ok(())
}

fn to_json(numbers: [u32; 2], versions: &[VersionRecord], pairs: &[ErrorPair<'_>]) -> Value {
    let sets = pairs.iter().map(|pair| {
        let ratio = pair.force_ratio();
        let better = ratio.filter(|ratio| *ratio != 1.0).map(|ratio| numbers[usize::from(ratio < 1.0)]);
        json!({ "name": pair.set, "structures": pair.structures, "errors": pair.errors, "force_mae_ratio": ratio,
                "better": better })
    });
    let sets: Vec<_> = sets.collect();
    json!({ "versions": numbers, "sets": sets, "only_in": only_in(numbers, versions, pairs) })
}
