//! Results of label jobs, as the cost model, `status` and the table of force errors read them.

use wire::ContentHash;

use super::{job_counts, protocols, walk_conditions};
use crate::Store;
use crate::database::{FromRow, SqlRow, query};
use crate::error::Result;
use crate::outcomes::{FailureCount, LabelCost, LabelUsage, Unlabelled, ValueRange};

/// The newest first: the cost of labels may change with the machine. Imported structures have no seed structure.
pub(crate) const COSTS: &str =
    "SELECT attempt.*, coalesce(candidate.seed_structure, 4294967295) AS seed_structure, structure.formula,
        structure.atoms AS size
    FROM label CROSS JOIN attempt ON attempt.job = label.job AND attempt.attempt = label.attempt
    CROSS JOIN job ON job.number = label.job CROSS JOIN structure ON structure.number = job.structure
    LEFT JOIN candidate ON candidate.decision = job.decision
    WHERE label.protocol = $1 ORDER BY label.number DESC LIMIT $2";

pub(crate) const CORES_IN_USE: &str =
    "SELECT attempt.* FROM job CROSS JOIN attempt ON attempt.job = job.number AND attempt.attempt = job.attempts
    WHERE job.state = 'leased'";

pub(crate) const FAILURE_CLASSES: &str = "SELECT class,
        count(DISTINCT CASE WHEN state = 'labelled' THEN job.number END),
        count(DISTINCT CASE WHEN state = 'failed' THEN job.number END),
        count(DISTINCT CASE WHEN state IN ('queued', 'leased') THEN job.number END)
    FROM attempt CROSS JOIN job ON job.number = attempt.job
    WHERE class IS NOT NULL AND job.protocol = $1 GROUP BY class ORDER BY class";

/// Grades are those of the walks $2 ≤ walk < $3: those of other versions of the potential are no measure for them.
pub(crate) const UNLABELLED: &str = "SELECT CASE WHEN seed_structure = 4294967295 THEN 'imported' ELSE coalesce(name, '') END AS seed_name,
        formula,
        CAST(sum(CASE WHEN state = 'failed' THEN 1 ELSE 0 END) AS BIGINT) AS failed,
        CAST(sum(CASE WHEN state = 'labelled' THEN 1 ELSE 0 END) AS BIGINT) AS labelled,
        min(CASE WHEN state = 'failed' THEN version_gamma END) AS gamma_low,
        max(CASE WHEN state = 'failed' THEN version_gamma END) AS gamma_high,
        min(CASE WHEN state = 'failed' THEN relative_volume END) AS volume_low,
        max(CASE WHEN state = 'failed' THEN relative_volume END) AS volume_high,
        min(CASE WHEN state = 'labelled' THEN version_gamma END) AS labelled_gamma_low,
        max(CASE WHEN state = 'labelled' THEN version_gamma END) AS labelled_gamma_high,
        min(CASE WHEN state = 'labelled' THEN relative_volume END) AS labelled_volume_low,
        max(CASE WHEN state = 'labelled' THEN relative_volume END) AS labelled_volume_high
    FROM (SELECT state, coalesce(candidate.seed_structure, 4294967295) AS seed_structure,
              coalesce(candidate.formula, (SELECT structure.formula FROM structure WHERE structure.number = job.structure)) AS formula,
              CASE WHEN candidate.walk >= $2 AND candidate.walk < $3 THEN original_gamma END AS version_gamma, relative_volume
          FROM job LEFT JOIN candidate ON candidate.decision = job.decision
          WHERE job.state IN ('failed', 'labelled') AND job.protocol = $1
          AND NOT EXISTS (SELECT 1 FROM label WHERE label.structure = job.structure AND label.protocol = job.protocol
                          AND status = 'excluded')) AS finished
    LEFT JOIN seed_structure AS seed ON seed.seed = finished.seed_structure
    GROUP BY seed_structure, name, formula
    HAVING sum(CASE WHEN state = 'failed' THEN 1 ELSE 0 END) > 0
    ORDER BY seed_structure, formula";

/// The same, without the ranges of labelled structures.
const FAILED: &str = "SELECT CASE WHEN failure.seed_structure = 4294967295 THEN 'imported' ELSE coalesce(name, '') END AS seed_name,
        failure.formula AS formula, count(*) AS failed,
        (SELECT CAST(coalesce(sum(job_count.number), 0) AS BIGINT) FROM job_count
         WHERE job_count.protocol = $1 AND job_count.state = 'labelled'
         AND job_count.seed_structure = failure.seed_structure AND job_count.formula = failure.formula)
        - (SELECT count(*) FROM label CROSS JOIN job AS own ON own.structure = label.structure AND own.protocol = label.protocol
           CROSS JOIN structure AS excluded ON excluded.number = own.structure
           LEFT JOIN candidate AS found ON found.decision = own.decision
           WHERE label.protocol = $1 AND status = 'excluded' AND own.state = 'labelled'
           AND coalesce(found.seed_structure, 4294967295) = failure.seed_structure
           AND excluded.formula = failure.formula) AS labelled,
        min(version_gamma) AS gamma_low, max(version_gamma) AS gamma_high,
        min(relative_volume) AS volume_low, max(relative_volume) AS volume_high,
        CAST(NULL AS DOUBLE PRECISION) AS labelled_gamma_low, CAST(NULL AS DOUBLE PRECISION) AS labelled_gamma_high,
        CAST(NULL AS DOUBLE PRECISION) AS labelled_volume_low, CAST(NULL AS DOUBLE PRECISION) AS labelled_volume_high
    FROM (SELECT coalesce(candidate.seed_structure, 4294967295) AS seed_structure, structure.formula AS formula,
              CASE WHEN candidate.walk >= $2 AND candidate.walk < $3 THEN original_gamma END AS version_gamma, relative_volume
          FROM job CROSS JOIN structure ON structure.number = job.structure
          LEFT JOIN candidate ON candidate.decision = job.decision
          WHERE job.state = 'failed' AND job.protocol = $1) AS failure
    LEFT JOIN seed_structure ON seed_structure.seed = failure.seed_structure
    GROUP BY failure.seed_structure, name, failure.formula ORDER BY failure.seed_structure, failure.formula";

/// Labels of structures that were not dropped, each counted with the walk that found its structure first.
const LABELS_BY_WALK: &str = "SELECT candidate.walk, count(*)
    FROM label CROSS JOIN job ON job.structure = label.structure AND job.protocol = label.protocol
    CROSS JOIN candidate ON candidate.decision = job.decision
    WHERE label.protocol = $1 AND status = 'label' AND job.state <> 'dropped'
    GROUP BY candidate.walk ORDER BY candidate.walk";

/// Minimum duration of a label, whatever the clock says.
const MIN_MILLISECONDS: i64 = 1;

impl Store {
    /// Costs of the newest labels made under this protocol, at most `limit`.
    pub async fn label_costs(&self, protocol: ContentHash, limit: u32) -> Result<Vec<LabelCost>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = protocols::protocol_id(&mut transaction, protocol).await?;
        let costs = query(COSTS).bind(protocol).bind(limit).fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        Ok(costs)
    }

    /// Resources used by attempts so far, and cores in use now.
    pub async fn label_usage(&self) -> Result<LabelUsage> {
        let mut transaction = self.database.begin_read().await?;
        let kept =
            "SELECT key, value FROM campaign WHERE key IN ('core_milliseconds', 'label_core_milliseconds')";
        let kept: Vec<(String, String)> = query(kept).fetch_all(&mut transaction).await?;
        let mut cores = 0;
        for row in query(CORES_IN_USE).rows(&mut transaction).await? {
            cores += row.get_or_default::<Option<u64>>("cores")?.unwrap_or(1);
        }
        transaction.commit().await?;
        let seconds = |name: &str| {
            let (_, milliseconds) = kept.iter().find(|(key, _)| key == name)?;
            Some(milliseconds.parse::<f64>().ok()? / 1000.0)
        };
        let label_core_seconds = seconds("label_core_milliseconds");
        Ok(LabelUsage { core_seconds: seconds("core_milliseconds"), label_core_seconds, cores })
    }

    /// Number of structures with a label under this protocol, by the walk that found them.
    pub async fn labels_by_walk(&self, protocol: ContentHash) -> Result<Vec<(u32, u64)>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = protocols::protocol_id(&mut transaction, protocol).await?;
        let counts = query(LABELS_BY_WALK).bind(protocol).fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        Ok(counts)
    }

    /// Failures of attempts under this protocol, by class.
    pub async fn failures(&self, protocol: ContentHash) -> Result<Vec<FailureCount>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = protocols::protocol_id(&mut transaction, protocol).await?;
        let rows: Vec<(String, u64, u64, u64)> =
            query(FAILURE_CLASSES).bind(protocol).fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        let count = |(class, labelled, failed, unfinished): (String, u64, u64, u64)| FailureCount {
            class,
            labelled,
            failed,
            unfinished,
        };
        Ok(rows.into_iter().map(count).collect())
    }

    /// Structures without a label because labelling under this protocol failed, by seed structure and formula. The
    /// ranges of γ are those of structures from walks with this version of the potential; all else is of all versions.
    /// Without `ranges` of the labelled ones, this reads only as many rows as there are failures.
    pub async fn unlabelled(
        &self,
        protocol: ContentHash,
        version: u32,
        ranges: bool,
    ) -> Result<Vec<Unlabelled>> {
        let mut transaction = self.database.begin_read().await?;
        let walks = walk_conditions::versions(&mut transaction).await?.walks_of(version);
        let protocol = protocols::protocol_id(&mut transaction, protocol).await?;
        let ranges = ranges || !job_counts::have_counts(&mut transaction).await?;
        let sql = if ranges { UNLABELLED } else { FAILED };
        let rows = query(sql).bind(protocol).bind(walks.start).bind(walks.end);
        let rows = rows.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        Ok(rows)
    }
}

impl FromRow for LabelCost {
    fn from_row(row: &SqlRow) -> Result<Self> {
        let (started, ended): (i64, Option<i64>) = (row.get("started")?, row.get("ended")?);
        let cores = row.get_or_default::<Option<u32>>("cores")?.unwrap_or(1);
        let milliseconds = ended.unwrap_or(started).saturating_sub(started).max(MIN_MILLISECONDS);
        let by_the_clock = milliseconds as f64 / 1000.0 * f64::from(cores);
        Ok(Self {
            seed_structure: row.get("seed_structure")?,
            formula: row.get("formula")?,
            atoms: row.get("size")?,
            electrons: row.get_or_default("electrons")?,
            k_points: row.get_or_default("k_points")?,
            core_seconds: row.get_or_default::<Option<f64>>("core_seconds")?.unwrap_or(by_the_clock),
        })
    }
}

impl FromRow for Unlabelled {
    fn from_row(row: &SqlRow) -> Result<Self> {
        let range =
            |low, high| -> Result<ValueRange> { Ok(ValueRange { low: row.get(low)?, high: row.get(high)? }) };
        Ok(Self {
            seed_structure: row.get("seed_name")?,
            formula: row.get("formula")?,
            failed: row.get("failed")?,
            labelled: row.get("labelled")?,
            gamma: range("gamma_low", "gamma_high")?,
            gamma_labelled: range("labelled_gamma_low", "labelled_gamma_high")?,
            relative_volume: range("volume_low", "volume_high")?,
            relative_volume_labelled: range("labelled_volume_low", "labelled_volume_high")?,
        })
    }
}
