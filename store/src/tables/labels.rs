//! Labels: the first valid result is the label, later results are checks, and a requested new label supersedes the
//! old one. If the campaign's rule says so, a result of a lower state supersedes a label too (`lower_states`). Nothing
//! is overwritten. An excluded label still makes later results checks.

use super::attempt_end::{end_attempt, job_row};
use super::label_row::encode_details;
use super::lower_states;
use super::relabel::status_of_result;
use crate::Store;
use crate::checksum::LABEL;
use crate::database::{Transaction, query};
use crate::encoding::{encode_vectors, integer};
use crate::error::{Result, StoreError};
use crate::jobs::{CompleteOutcome, LabelSource, LabelStatus};
use crate::records::{Label, LabelDetails, Lease};

impl Store {
    /// Delivers the result of a leased job. The first valid result for structure and protocol becomes the label,
    /// whether or not the lease is still held; later results are stored as checks. If a new label was requested
    /// ([`Store::relabel`]), the first result of an attempt that began after the request becomes the label and
    /// supersedes the old one. [`Store::set_lower_state_rule`] may prefer a lower state. A job that was dropped or
    /// superseded meanwhile stays so. The label's details get the retry adjustments of its calculation
    /// ([`Store::record_calculation`]), and whether the lease was by value. Delivering the result of an attempt
    /// twice changes nothing.
    ///
    /// # Errors
    /// [`StoreError::InvalidLabel`] for a wrong number of forces, or for numbers that are not finite.
    pub async fn complete(&self, lease: &Lease, label: &Label, now: i64) -> Result<CompleteOutcome> {
        let mut transaction = self.database.begin().await?;
        let structure = query("SELECT structure FROM job WHERE number = $1").bind(lease.job);
        let structure: Option<i64> = structure.fetch_optional(&mut transaction).await?;
        // Lock order: the structure first, then its job.
        if let Some(structure) = structure {
            check(&mut transaction, structure, label).await?;
        }
        let job = job_row(&mut transaction, lease.job).await?;
        let sql =
            "SELECT status FROM label WHERE structure = $1 AND protocol = $2 AND job = $3 AND attempt = $4";
        let before = query(sql).bind(job.structure).bind(job.protocol);
        let before = before.bind(lease.job).bind(lease.attempt).fetch_optional(&mut transaction).await?;
        let before: Option<String> = before;
        if let Some(status) = before {
            let check = status == LabelStatus::Check.name();
            return Ok(if check { CompleteOutcome::KeptAsCheck } else { CompleteOutcome::Label });
        }
        let source = LabelSource::Attempt { job: lease.job, attempt: lease.attempt };
        let label = with_calculation_details(&mut transaction, lease, label).await?;
        let status = add(&mut transaction, job.structure, job.protocol, &label, &source, now).await?;
        let outcome = if status == LabelStatus::Label { "labelled" } else { "check" };
        let sql = "UPDATE attempt SET ended = $1, outcome = $2 WHERE job = $3 AND attempt = $4";
        let query = query(sql).bind(now).bind(outcome).bind(lease.job).bind(lease.attempt);
        query.execute(&mut transaction).await?;
        finish_job(&mut transaction, job.structure, job.protocol, now).await?;
        transaction.commit().await?;
        Ok(if status == LabelStatus::Label { CompleteOutcome::Label } else { CompleteOutcome::KeptAsCheck })
    }
}

/// The label with the retry adjustments of its calculation, and whether the lease was by value: its job may have got another value, or
/// none, since.
async fn with_calculation_details(
    transaction: &mut Transaction,
    lease: &Lease,
    label: &Label,
) -> Result<Label> {
    let found = query("SELECT remedies FROM attempt WHERE job = $1 AND attempt = $2");
    let found = found.bind(lease.job).bind(lease.attempt);
    let names: Option<Option<String>> = found.fetch_optional(&mut *transaction).await?;
    let mut label = label.clone();
    label.details.ordered_by_value = lease.ordered_by_value;
    if let Some(names) = names.flatten() {
        label.details.retry_adjustments = names.split(',').map(str::to_owned).collect();
    }
    Ok(label)
}

/// Checks that the label fits the structure. Locks the structure: until the end of the transaction, no other label
/// or job is added for it.
pub(super) async fn check(transaction: &mut Transaction, structure: i64, label: &Label) -> Result<()> {
    let atoms = query("SELECT atoms FROM structure WHERE number = $1").bind(structure);
    let atoms: u64 = atoms.locked().fetch_one(&mut *transaction).await?;
    let invalid = |reason: String| Err(StoreError::InvalidLabel(reason));
    if label.forces.len() as u64 != atoms {
        return invalid(format!("{} forces for {atoms} atoms", label.forces.len()));
    }
    if !label.energy.is_finite() {
        return invalid(format!("the energy is {}", label.energy));
    }
    let stress = label.stress.iter().flatten();
    if label.forces.iter().chain(stress).flatten().any(|x| !x.is_finite()) {
        return invalid("forces or stress have entries that are not finite".into());
    }
    // JSON cannot represent them; they would be read back as null.
    let LabelDetails { energy_without_smearing, magnetic_moments, magnetisation, .. } = &label.details;
    let details =
        energy_without_smearing.iter().chain(magnetisation).chain(magnetic_moments.iter().flatten());
    if details.into_iter().any(|x| !x.is_finite()) {
        return invalid("moments or energies in its details are not finite".into());
    }
    Ok(())
}

/// Adds a result: the label if there is none or a new one was requested, otherwise a check. The campaign's rule may make the
/// lower of two states the label instead. The structure must be locked.
pub(super) async fn add(
    transaction: &mut Transaction,
    structure: i64,
    protocol: i64,
    label: &Label,
    source: &LabelSource,
    now: i64,
) -> Result<LabelStatus> {
    let status = status_of_result(transaction, structure, protocol, source, now).await?;
    let (mut job, mut attempt, mut file, mut frame) = (None, None, None, None);
    match source {
        LabelSource::Attempt { job: j, attempt: a } => (job, attempt) = (Some(*j), Some(*a)),
        LabelSource::Import { file: name, frame: number } => {
            (file, frame) = (Some(name.as_str()), Some(integer("frame", *number)?));
        }
    }
    let sql =
        "INSERT INTO label (structure, protocol, energy, forces, stress, job, attempt, file, frame, received, details,
                            checksum, status)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13) RETURNING number";
    let row = vec![
        structure.into(),
        protocol.into(),
        label.energy.into(),
        encode_vectors(&label.forces).into(),
        label.stress.map(|stress| encode_vectors(&stress)).into(),
        job.into(),
        attempt.into(),
        file.into(),
        frame.into(),
        now.into(),
        encode_details(&label.details).into(),
    ];
    let insert = query(sql).bind_all(LABEL.with_checksum(row)).bind(status.name());
    let number: i64 = insert.fetch_one(&mut *transaction).await?;
    let applied = lower_states::apply_rule(transaction, structure, protocol, number, now).await?;
    Ok(applied.unwrap_or(status))
}

/// Marks the structure's job as done, unless it was dropped or waits for another label.
pub(super) async fn finish_job(
    transaction: &mut Transaction,
    structure: i64,
    protocol: i64,
    now: i64,
) -> Result<()> {
    let sql = "UPDATE job SET state = 'labelled', holder = NULL, expires = NULL
               WHERE structure = $1 AND protocol = $2 AND state IN ('queued', 'leased', 'failed')
               AND relabel IS NULL RETURNING number";
    let job = query(sql).bind(structure).bind(protocol);
    if let Some(job) = job.fetch_optional(&mut *transaction).await? {
        end_attempt(transaction, job, "overtaken", now).await?;
    }
    Ok(())
}
