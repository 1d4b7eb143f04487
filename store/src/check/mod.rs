//! Checks a database: first the database's own check, then the invariants of this program.
//!
//! Reads a snapshot in pages and writes nothing, so a campaign may run meanwhile.

mod archives;
mod contents;
pub(crate) mod export;
mod finding;
mod rules;
mod versions;

use self::contents::Contents;
use crate::Store;
use crate::database::{Transaction, query};
use crate::error::{Result, StoreError};
use crate::tables::checksums;

pub use self::finding::Finding;

const RESTORE: &str = "the file is damaged; restore the campaign from a backup";

impl Store {
    /// Checks everything. `on_progress` receives the number of rows read and the total. This crate treats components of
    /// the mixture as bytes: check those of [`Store::load_components`] with the crate that decodes them.
    pub async fn check(&self, mut on_progress: impl FnMut(u64, u64)) -> Result<Vec<Finding>> {
        let mut transaction = self.database.begin_read().await?;
        let mut findings = Vec::new();
        own_check(&mut transaction, &mut findings).await?;
        match ours(&mut transaction, &mut findings, &mut on_progress).await {
            // An error of the database itself: it is reported already, or here.
            Err(StoreError::Damaged { what, reason }) => {
                findings.push(Finding { what: format!("{what} cannot be read ({reason})"), then: RESTORE });
            }
            checked => checked?,
        }
        Ok(findings)
    }

    /// Computes the missing checksums, after rows were written without this program.
    #[doc(hidden)]
    pub async fn write_checksums(&self) -> Result<()> {
        let mut transaction = self.database.begin_as_leader().await?;
        checksums::fill(&mut transaction).await?;
        transaction.commit().await
    }
}

async fn ours(
    transaction: &mut Transaction,
    findings: &mut Vec<Finding>,
    on_progress: &mut dyn FnMut(u64, u64),
) -> Result<()> {
    for rule in rules::all_rules() {
        findings.extend(rule.find(transaction).await?);
    }
    findings.extend(rules::labelled_jobs(transaction).await?);
    findings.extend(rules::counts(transaction).await?);
    findings.extend(rules::job_counts(transaction).await?);
    findings.extend(rules::leases(transaction).await?);
    findings.extend(rules::sums(transaction).await?);
    findings.extend(versions::rules(transaction).await?);
    findings.extend(Contents::check(transaction, on_progress).await?);
    Ok(())
}

/// Runs some of SQLite's own checks. A server takes care of its files itself.
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

/// SQLite checks every page, indexes and references. A server takes care of its files itself and enforces
/// references.
async fn own_check(transaction: &mut Transaction, findings: &mut Vec<Finding>) -> Result<()> {
    if !matches!(transaction, Transaction::Sqlite(_)) {
        return Ok(());
    }
    findings.extend(own_check_of(transaction, &["PRAGMA integrity_check(20)"]).await?);
    let sql = "SELECT count(*), min(\"table\" || ' to ' || parent) FROM pragma_foreign_key_check";
    let (count, example): (u64, Option<String>) = query(sql).fetch_one(&mut *transaction).await?;
    if count > 0 {
        let what = format!("{count} rows refer to missing rows ({})", example.unwrap_or_default());
        findings.push(Finding { what, then: RESTORE });
    }
    Ok(())
}
