//! Labelled structures that may nearly duplicate one that waits for its label.

use atoms::Structure;

use super::walk_conditions;
use crate::Store;
use crate::checksum::{CANDIDATE, FEATURES, Names, joined};
use crate::database::{FromRow, SqlRow, query};
use crate::encoding::read_structure;
use crate::error::Result;
use crate::numbers::decode_numbers;
use crate::outcomes::NearDuplicate;
use crate::records::Lease;

const OWN: &str = concat!(
    "SELECT candidate.decision AS decision, candidate.formula AS formula, candidate.energy AS energy, features,
        features_checksum, ",
    joined!(candidate),
    " FROM job CROSS JOIN candidate ON candidate.decision = job.decision
    CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision WHERE job.number = $1"
);

/// Compares only the nearest in energy: nearly equal features have nearly equal energies.
pub(crate) const NEAR: &str = concat!(
    "SELECT candidate.decision AS decision, id, features, features_checksum, ",
    joined!(structure),
    " FROM (SELECT candidate.decision AS place FROM candidate
          CROSS JOIN job ON job.structure = candidate.structure AND job.protocol = $4 AND job.state = 'labelled'
          AND NOT EXISTS (SELECT 1 FROM label WHERE label.structure = job.structure
                          AND label.protocol = job.protocol AND status = 'excluded')
          WHERE formula = $1 AND fate = 'accepted' AND energy IS NOT NULL AND candidate.decision <> $2
          AND candidate.walk >= $6 AND candidate.walk < $7
          ORDER BY abs(energy - $3) LIMIT $5) AS page
    CROSS JOIN candidate ON candidate.decision = place
    CROSS JOIN candidate_data ON candidate_data.decision = place
    CROSS JOIN structure ON structure.number = candidate.structure"
);

struct Own {
    decision: i64,
    walk: u32,
    formula: String,
    energy: Option<f64>,
    features: Option<Vec<u8>>,
}

struct Near {
    id: String,
    structure: Structure,
    features: Option<Vec<u8>>,
}

impl FromRow for Own {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Joined)?;
        FEATURES.verify(row)?;
        Ok(Self {
            decision: row.get("decision")?,
            walk: row.get("candidate__walk")?,
            formula: row.get("formula")?,
            energy: row.get("energy")?,
            features: row.get("features")?,
        })
    }
}

impl FromRow for Near {
    fn from_row(row: &SqlRow) -> Result<Self> {
        FEATURES.verify(row)?;
        Ok(Self { id: row.get("id")?, structure: read_structure(row)?, features: row.get("features")? })
    }
}

impl Store {
    /// Features of the leased structure, [n × D], and features of labelled structures under the same protocol with
    /// the same atoms in the same order, among the `limit` nearest in energy. All are from walks with the same version of the
    /// potential: features and energies of different versions cannot be compared. `None` if its own features were not
    /// stored, as those of imported structures.
    pub async fn near_duplicates(
        &self,
        lease: &Lease,
        limit: u32,
    ) -> Result<Option<(Vec<f64>, Vec<NearDuplicate>)>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = super::protocols::protocol_id(&mut transaction, lease.protocol).await?;
        let own: Option<Own> = query(OWN).bind(lease.job).fetch_optional(&mut transaction).await?;
        let Some(own) = own else { return Ok(None) };
        let (Some(energy), Some(features)) = (own.energy, own.features) else { return Ok(None) };
        let versions = walk_conditions::versions(&mut transaction).await?;
        let walks = versions.walks_of(versions.version_of(own.walk));
        let near = query(NEAR).bind(own.formula).bind(own.decision).bind(energy).bind(protocol).bind(limit);
        let near = near.bind(walks.start).bind(walks.end);
        let near: Vec<Near> = near.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        let mut others = Vec::new();
        for Near { id, structure, features } in near {
            let Some(features) = features else { continue };
            if structure.species == lease.structure.species {
                others.push(NearDuplicate { candidate: id, features: decode_numbers(&features)? });
            }
        }
        Ok(Some((decode_numbers(&features)?, others)))
    }
}
