//! Structures that may be almost the same as one that waits for its label.

use crate::Store;
use crate::database::{from_columns, query};
use crate::encoding::decode_structure;
use crate::error::Result;
use crate::numbers::decode_numbers;
use crate::outcomes::NearLabel;
use crate::records::Lease;

const OWN: &str = "SELECT candidate.decision AS decision, formula, energy, features
    FROM job CROSS JOIN candidate ON candidate.decision = job.decision
    CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision WHERE job.number = $1";

/// Only the nearest in energy are looked into: features that are almost the same have almost the same energy.
pub(crate) const NEAR: &str = "SELECT id, hash, data, features
    FROM (SELECT candidate.decision AS place FROM candidate
          CROSS JOIN job ON job.structure = candidate.structure AND job.protocol = $4 AND job.state = 'labelled'
          WHERE formula = $1 AND fate = 'accepted' AND energy IS NOT NULL AND candidate.decision <> $2
          ORDER BY abs(energy - $3) LIMIT $5) AS page
    CROSS JOIN candidate ON candidate.decision = place
    CROSS JOIN candidate_data ON candidate_data.decision = place
    CROSS JOIN structure ON structure.number = candidate.structure";

struct Own {
    decision: i64,
    formula: String,
    energy: Option<f64>,
    features: Option<Vec<u8>>,
}

struct Near {
    id: String,
    hash: Vec<u8>,
    data: Vec<u8>,
    features: Option<Vec<u8>>,
}

from_columns!(Own { decision, formula, energy, features });
from_columns!(Near { id, hash, data, features });

impl Store {
    /// Features of the leased structure, [n × D], and of those with the same atoms in the same order that have their labels
    /// by the same protocol: of the `limit` that are nearest in energy. `None` if its own were not kept.
    pub async fn labelled_near(
        &self,
        lease: &Lease,
        limit: u32,
    ) -> Result<Option<(Vec<f64>, Vec<NearLabel>)>> {
        let mut transaction = self.database.begin_to_read().await?;
        let protocol = super::protocols::number(&mut transaction, lease.protocol).await?;
        let own: Own = query(OWN).bind(lease.job).fetch_one(&mut transaction).await?;
        let (Some(energy), Some(features)) = (own.energy, own.features) else { return Ok(None) };
        let near = query(NEAR).bind(own.formula).bind(own.decision).bind(energy).bind(protocol).bind(limit);
        let near: Vec<Near> = near.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        let mut others = Vec::new();
        for Near { id, hash, data, features } in near {
            let Some(features) = features else { continue };
            if decode_structure(&data, &hash)?.species == lease.structure.species {
                others.push(NearLabel { candidate: id, features: decode_numbers(&features)? });
            }
        }
        Ok(Some((decode_numbers(&features)?, others)))
    }
}
