//! Whether a database holds what it should: the database's own check, then what this program promises of it.
//!
//! Everything is seen at one instant and only read, so a campaign may run meanwhile. Rows are read some at a time.

mod archives;
mod contents;
pub(crate) mod export;
mod rules;

use std::fmt;

use self::contents::Contents;
use crate::Store;
use crate::database::{Transaction, query};
use crate::error::{Result, StoreError};

/// Something that is not as it should be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// What was found, with an example.
    pub what: String,
    /// What it means, and what to do.
    pub then: &'static str,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.what, self.then)
    }
}

const RESTORE: &str = "the file is damaged; restore the campaign from a backup";

impl Store {
    /// Checks everything; `tell` hears how many rows were read, and of how many. Components of the mixture are bytes to
    /// this crate: whoever knows them checks [`Store::load_components`].
    pub async fn check(&self, mut tell: impl FnMut(u64, u64)) -> Result<Vec<Finding>> {
        let mut transaction = self.database.begin_to_read().await?;
        let mut findings = Vec::new();
        own_check(&mut transaction, &mut findings).await?;
        match ours(&mut transaction, &mut findings, &mut tell).await {
            // What the database itself cannot read: that was said, or is now.
            Err(StoreError::Damaged { what, reason }) => {
                findings.push(Finding { what: format!("{what} cannot be read ({reason})"), then: RESTORE });
            }
            checked => checked?,
        }
        Ok(findings)
    }
}

async fn ours(
    transaction: &mut Transaction,
    findings: &mut Vec<Finding>,
    tell: &mut dyn FnMut(u64, u64),
) -> Result<()> {
    for rule in rules::all_rules() {
        findings.extend(rule.find(transaction).await?);
    }
    findings.extend(rules::labelled_jobs(transaction).await?);
    findings.extend(rules::counts(transaction).await?);
    findings.extend(rules::job_counts(transaction).await?);
    findings.extend(rules::leases(transaction).await?);
    findings.extend(rules::sums(transaction).await?);
    findings.extend(Contents::check(transaction, tell).await?);
    Ok(())
}

/// What SQLite finds with some of its checks; a server looks after its files itself.
async fn own_check_of(transaction: &mut Transaction, checks: &[&'static str]) -> Result<Vec<Finding>> {
    let mut findings = Vec::new();
    if matches!(transaction, Transaction::Sqlite(_)) {
        for check in checks {
            let lines: Vec<String> = query(check).fetch_all(&mut *transaction).await?;
            let wrong = lines.into_iter().filter(|line| line != "ok");
            findings.extend(wrong.map(|line| Finding { what: format!("SQLite: {line}"), then: RESTORE }));
        }
    }
    Ok(findings)
}

/// SQLite looks at every page, at its indexes and at references. A server looks after its files itself, and keeps
/// references whole.
async fn own_check(transaction: &mut Transaction, findings: &mut Vec<Finding>) -> Result<()> {
    if !matches!(transaction, Transaction::Sqlite(_)) {
        return Ok(());
    }
    findings.extend(own_check_of(transaction, &["PRAGMA integrity_check(20)"]).await?);
    let sql = "SELECT count(*), min(\"table\" || ' to ' || parent) FROM pragma_foreign_key_check";
    let (count, example): (u64, Option<String>) = query(sql).fetch_one(&mut *transaction).await?;
    if count > 0 {
        let what = format!("{count} rows refer to rows that are not there ({})", example.unwrap_or_default());
        findings.push(Finding { what, then: RESTORE });
    }
    Ok(())
}
