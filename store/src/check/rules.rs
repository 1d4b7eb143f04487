//! Invariants between rows.

use super::finding::Finding;
use crate::database::{Transaction, query};
use crate::error::Result;
use crate::processes::ProcessRecord;
use crate::tables::budget::SUMS;
use crate::tables::job_counts;
use crate::tables::processes::{LEASED, all};
use crate::tables::relabel;

/// A query that counts violations, with an example.
pub(super) struct ConsistencyRule {
    pub finds: &'static str,
    pub what: &'static str,
    pub then: &'static str,
}

impl ConsistencyRule {
    pub async fn find(&self, transaction: &mut Transaction) -> Result<Option<Finding>> {
        let (count, example): (u64, Option<String>) = query(self.finds).fetch_one(&mut *transaction).await?;
        let what = || format!("{count} {} (such as {})", self.what, example.unwrap_or_default());
        Ok((count > 0).then(|| Finding { what: what(), then: self.then }))
    }
}

pub(super) const LOST: &str = "something was lost or changed by hand; restore the campaign from a backup";
const QUEUE: &str =
    "the label queue was changed by hand; calmwalk queue shows the jobs; a backup has the original ones";

/// Violations that make structures or labels missing in an export without being noticed there.
const LOSSES: [ConsistencyRule; 7] = [
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(sequence) AS TEXT) FROM decision WHERE sequence > 1
                AND NOT EXISTS (SELECT 1 FROM decision AS before WHERE before.sequence = decision.sequence - 1)",
        what: "gaps in the decision log, before the decision",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(sequence) AS TEXT) FROM decision WHERE sequence < 1",
        what: "decisions with numbers below 1",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), min(candidate) FROM decision WHERE candidate IS NOT NULL
                AND NOT EXISTS (SELECT 1 FROM candidate WHERE candidate.decision = decision.sequence)",
        what: "decisions on missing candidates",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(number) AS TEXT) FROM import
                WHERE NOT EXISTS (SELECT 1 FROM label WHERE label.structure = import.structure)
                AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = import.structure)",
        what: "imported structures without any label or label job",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(number) AS TEXT) FROM label WHERE file IS NOT NULL
                AND NOT EXISTS (SELECT 1 FROM import WHERE import.structure = label.structure)",
        what: "labels imported with structures that are missing",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(label.number) AS TEXT) FROM label
                LEFT JOIN job ON job.number = label.job
                LEFT JOIN attempt ON attempt.job = label.job AND attempt.attempt = label.attempt
                WHERE label.job IS NOT NULL AND (job.number IS NULL OR attempt.attempt IS NULL
                OR job.structure <> label.structure OR job.protocol <> label.protocol)",
        what: "labels that do not belong to their job",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(structure) AS TEXT) FROM label WHERE status = 'superseded' AND NOT EXISTS (
                SELECT 1 FROM label AS other WHERE other.structure = label.structure AND other.status IN ('label', 'excluded'))",
        what: "superseded labels of structures without another label, of the structure",
        then: LOST,
    },
];

/// Everything else.
const RULES: [ConsistencyRule; 11] = [
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(number) AS TEXT) FROM job
                WHERE NOT EXISTS (SELECT 1 FROM candidate WHERE candidate.decision = job.decision)
                AND NOT EXISTS (SELECT 1 FROM import WHERE import.structure = job.structure
                                AND job.decision = 1099511627776 + import.number)",
        what: "label jobs of neither a candidate nor an imported structure",
        then: QUEUE,
    },
    ConsistencyRule {
        finds: "SELECT count(*), min(id) FROM candidate JOIN decision ON sequence = decision
                WHERE candidate.id IS DISTINCT FROM decision.candidate OR kind <>
                CASE origin WHEN 'control' THEN 'control' ELSE fate END",
        what: "candidates that contradict their decision",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), min(id) FROM candidate
                WHERE NOT EXISTS (SELECT 1 FROM decision WHERE sequence = candidate.decision)",
        what: "candidates without a decision",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), min(id) FROM candidate
                WHERE NOT EXISTS (SELECT 1 FROM candidate_data WHERE candidate_data.decision = candidate.decision)",
        what: "candidates without their structure and grades",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), min(id) FROM candidate JOIN structure ON structure.number = candidate.structure
                WHERE content <> hash",
        what: "candidates that refer to another structure than their own",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), min(id) FROM candidate WHERE structure IS NOT NULL
                AND EXISTS (SELECT 1 FROM campaign WHERE key = 'protocol')
                AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = candidate.structure)",
        what: "accepted candidates without a label job",
        then: "they will not be labelled; the next calmwalk run queues them",
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(walk.walk) AS TEXT) FROM walk WHERE accepted <>
                (SELECT count(*) FROM candidate WHERE candidate.walk = walk.walk AND fate = 'accepted')",
        what: "walks with a wrong count of accepted structures",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), min(id) FROM candidate
                WHERE NOT EXISTS (SELECT 1 FROM walk WHERE walk.walk = candidate.walk)",
        what: "candidates of missing walks",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(number) AS TEXT) FROM job WHERE state = 'superseded' AND NOT EXISTS (
                SELECT 1 FROM job AS other WHERE other.structure = job.structure AND other.state <> 'superseded')",
        what: "superseded jobs of structures without another job",
        then: QUEUE,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(number) AS TEXT) FROM job
                WHERE attempts <> (SELECT coalesce(max(attempt), 0) FROM attempt WHERE attempt.job = job.number)
                OR attempts <> (SELECT count(*) FROM attempt WHERE attempt.job = job.number)",
        what: "jobs with a wrong count of attempts",
        then: QUEUE,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(attempt.job) AS TEXT) FROM attempt JOIN job ON job.number = attempt.job
                WHERE outcome IS NULL AND NOT (state = 'leased' AND attempt = attempts)",
        what: "running attempts at jobs that are not leased",
        then: QUEUE,
    },
];

pub(super) fn all_rules() -> impl Iterator<Item = &'static ConsistencyRule> {
    LOSSES.iter().chain(&RULES)
}

/// Checks for missing rows.
pub(super) async fn losses(transaction: &mut Transaction) -> Result<Vec<Finding>> {
    let mut findings = Vec::new();
    for rule in &LOSSES {
        findings.extend(rule.find(transaction).await?);
    }
    findings.extend(labelled_jobs(transaction).await?);
    findings.extend(counts(transaction).await?);
    findings.extend(job_counts(transaction).await?);
    Ok(findings)
}

/// Jobs that contradict their labels.
macro_rules! disagreeing {
    ($but:literal) => {
        concat!(
            "SELECT count(*), CAST(min(job.number) AS TEXT) FROM job WHERE (state = 'labelled') <> EXISTS (
            SELECT 1 FROM label WHERE label.structure = job.structure AND label.protocol = job.protocol
            AND status IN ('label', 'excluded')) AND state <> 'dropped'",
            $but
        )
    };
}

/// Labelled jobs have a label; other jobs have one only if a new label was requested.
pub(super) async fn labelled_jobs(transaction: &mut Transaction) -> Result<Vec<Finding>> {
    let sql = match relabel::has_relabel_columns(transaction).await? {
        true => disagreeing!(" AND NOT (state IN ('queued', 'leased') AND relabel IS NOT NULL)"),
        false => disagreeing!(""),
    };
    let (count, example): (u64, Option<String>) = query(sql).fetch_one(&mut *transaction).await?;
    let what = || {
        let example = example.unwrap_or_default();
        format!("{count} jobs labelled without a label, or not labelled despite one (such as {example})")
    };
    Ok((count > 0).then(|| Finding { what: what(), then: QUEUE }).into_iter().collect())
}

/// Compares the counts of candidates with the rows.
const COUNTS: &str = "SELECT count(*), min(coalesce(found.origin, kept.origin) || ' ' || coalesce(found.fate, kept.fate))
    FROM (SELECT origin, coalesce(reason, fate) AS fate, count(*) AS number FROM candidate GROUP BY 1, 2) AS found
    FULL JOIN candidate_count AS kept ON kept.origin = found.origin AND kept.fate = found.fate
    WHERE found.number IS DISTINCT FROM kept.number";

/// Checks stored counts against the rows.
pub(super) async fn counts(transaction: &mut Transaction) -> Result<Vec<Finding>> {
    if !transaction.has_table("candidate_count").await? {
        return Ok(Vec::new());
    }
    let (count, example): (u64, Option<String>) = query(COUNTS).fetch_one(&mut *transaction).await?;
    let what = || {
        format!("{count} kinds of candidates are counted wrongly (such as {})", example.unwrap_or_default())
    };
    Ok((count > 0).then(|| Finding { what: what(), then: LOST }).into_iter().collect())
}

/// The same for label jobs.
pub(super) async fn job_counts(transaction: &mut Transaction) -> Result<Vec<Finding>> {
    if !job_counts::have_counts(transaction).await? {
        return Ok(Vec::new());
    }
    let (count, example): (u64, Option<String>) =
        query(job_counts::WRONG).fetch_one(&mut *transaction).await?;
    let what = || {
        format!("{count} kinds of label jobs are counted wrongly (such as {})", example.unwrap_or_default())
    };
    Ok((count > 0).then(|| Finding { what: what(), then: QUEUE }).into_iter().collect())
}

/// Checks for leases of processes that no longer exist.
pub(super) async fn leases(transaction: &mut Transaction) -> Result<Vec<Finding>> {
    let leased: Vec<(i64, String)> = query(LEASED).fetch_all(&mut *transaction).await?;
    let mut living = all(transaction).await?;
    living.retain(|process: &ProcessRecord| !process.is_dead());
    let is_lost = |holder: &str| !living.iter().any(|process| process.is_holder(holder));
    let lost: Vec<_> = leased.iter().filter(|(_, holder)| is_lost(holder)).collect();
    let Some((job, holder)) = lost.first() else { return Ok(Vec::new()) };
    let what =
        format!("{} jobs are leased to processes that are gone (such as {job} to {holder})", lost.len());
    Ok(vec![Finding { what, then: "the next calmwalk run, or calmwalk label, takes them back" }])
}

/// Checks the totals that budgets use. Tables of an earlier version have none.
pub(super) async fn sums(transaction: &mut Transaction) -> Result<Vec<Finding>> {
    let mut findings = Vec::new();
    for (name, sum) in SUMS {
        let kept = query("SELECT value FROM campaign WHERE key = $1").bind(name);
        let kept: Option<String> = kept.fetch_optional(&mut *transaction).await?;
        let Some(kept) = kept else { continue };
        let found: String = query(sum).fetch_one(&mut *transaction).await?;
        if kept != found {
            let what = format!("the sum of {name} over all attempts is {found}, and {kept} is kept");
            findings.push(Finding { what, then: QUEUE });
        }
    }
    Ok(findings)
}
