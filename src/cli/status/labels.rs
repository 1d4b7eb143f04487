//! What labels cost and which of them failed, in `calmwalk status`.

use std::io::{self, Write};

use serde_json::{Value, json};
use store::{FailureCount, Store, StoreError, Unlabelled};

use crate::bill::{self, Bill, digits};
use crate::unlabelled;

/// Lines for seed structures with failed labels, unless all are asked for.
const SHOWN: usize = 8;

/// What is known of the labels of the protocol in force.
#[derive(Clone, Debug, Default)]
pub struct LabelsSoFar {
    bill: Bill,
    failures: Vec<FailureCount>,
    unlabelled: Vec<Unlabelled>,
}

impl LabelsSoFar {
    /// Reads it; nothing without a protocol.
    pub async fn of(store: &Store) -> Result<Self, StoreError> {
        let Some(protocol) = store.protocol_in_force().await? else { return Ok(Self::default()) };
        let failures = store.failures(protocol.hash).await?;
        let unlabelled = match failures.iter().any(|class| class.given_up > 0) {
            true => store.unlabelled(protocol.hash).await?,
            false => Vec::new(),
        };
        Ok(Self { bill: bill::of(store, protocol.hash).await?, failures, unlabelled })
    }

    /// Adds it to the state of a campaign; `used` are the core-hours so far.
    pub fn add_to(&self, json: &mut Value, used: f64) {
        json["cost"] = json!({ "core_hours": used, "queue": self.bill });
        json["failures"] = json!(self.failures);
        json["unlabelled"] = json!(self.unlabelled);
    }

    /// Cost, failures and what is unlabelled because of them.
    pub fn write(&self, out: &mut dyn Write, used: f64, all: bool) -> io::Result<()> {
        let Bill { unfinished, remaining, hours_left, cores, measured, overhead } = &self.bill;
        let used = digits(used);
        match remaining {
            None if *unfinished == 0 => writeln!(out, "cost        {used} core-hours so far")?,
            None => writeln!(
                out,
                "cost        {used} core-hours so far; that of {unfinished} labels to come is unknown before a first one"
            )?,
            Some(hours) => {
                writeln!(
                    out,
                    "cost        {used} core-hours so far; {unfinished} labels to come: about {hours}"
                )?;
                write!(out, "            as {measured} labels so far")?;
                if *overhead > 1.005 {
                    write!(out, ", attempts in vain add {:.0} %", 100.0 * (overhead - 1.0))?;
                }
                match hours_left {
                    Some(hours) => {
                        writeln!(out, "; done in {} h on the {cores} cores at work", digits(*hours))?
                    }
                    None => writeln!(out, "; nobody is at work on them")?,
                }
            }
        }
        self.write_failures(out, all)
    }

    fn write_failures(&self, out: &mut dyn Write, all: bool) -> io::Result<()> {
        for (k, FailureCount { class, labelled, given_up, unfinished }) in self.failures.iter().enumerate() {
            let (title, class) = (if k == 0 { "failures" } else { "" }, class.replace('_', " "));
            let jobs = labelled + given_up + unfinished;
            writeln!(
                out,
                "{title:<12}{class} in {jobs}: {labelled} labelled all the same, {given_up} given up, {unfinished} not done"
            )?;
        }
        let shown = if all { usize::MAX } else { SHOWN };
        out.write_all(unlabelled::shown(&self.unlabelled, 12, shown).as_bytes())
    }
}
