//! Energies of labelled structures, by the potential and by their labels.

use atoms::Species;
use wire::ContentHash;

use super::{protocols, walk_conditions};
use crate::Store;
use crate::database::{from_columns, query};
use crate::error::{Result, StoreError};
use crate::outcomes::LabelledEnergies;

/// The newest labels of structures that were not dropped.
const ENERGIES: &str =
    "SELECT job.decision AS decision, formula, candidate.energy AS model, label.energy AS label
    FROM label CROSS JOIN job ON job.structure = label.structure AND job.protocol = label.protocol
    CROSS JOIN candidate ON candidate.decision = job.decision
    WHERE label.protocol = $1 AND status = 'label' AND job.state <> 'dropped' AND candidate.energy IS NOT NULL
    AND candidate.walk >= $3 AND candidate.walk < $4
    ORDER BY label.number DESC LIMIT $2";

struct EnergyRow {
    decision: i64,
    formula: String,
    model: f64,
    label: f64,
}

from_columns!(EnergyRow { decision, formula, model, label });

impl Store {
    /// Energies of the structures from walks with this version of the potential that were most recently labelled under this
    /// protocol, at most `limit`, in decision order. Leaves out labels dropped or excluded by hand.
    pub async fn labelled_energies(
        &self,
        protocol: ContentHash,
        version: u32,
        limit: u32,
    ) -> Result<Vec<LabelledEnergies>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = protocols::protocol_id(&mut transaction, protocol).await?;
        let walks = walk_conditions::versions(&mut transaction).await?.walks_of(version);
        let rows = query(ENERGIES).bind(protocol).bind(limit).bind(walks.start).bind(walks.end);
        let mut rows: Vec<EnergyRow> = rows.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        // Decision order makes sums over them independent of when labels arrived.
        rows.sort_by_key(|row| row.decision);
        rows.into_iter().map(EnergyRow::into_energies).collect()
    }
}

impl EnergyRow {
    fn into_energies(self) -> Result<LabelledEnergies> {
        let Self { formula, model, label, .. } = self;
        let damaged = || StoreError::damaged("a candidate", format!("its formula is '{formula}'"));
        let composition = composition(&formula).ok_or_else(damaged)?;
        Ok(LabelledEnergies { composition, model, label })
    }
}

/// Elements and counts of a formula written by [`atoms::Structure::formula`]; `None` for another text.
fn composition(formula: &str) -> Option<Vec<(Species, u32)>> {
    let mut composition = Vec::new();
    let mut rest = formula;
    while !rest.is_empty() {
        let symbol = rest.len() - rest.get(1..)?.trim_start_matches(|c: char| c.is_ascii_lowercase()).len();
        let (symbol, behind) = rest.split_at(symbol);
        let next = behind.trim_start_matches(|c: char| c.is_ascii_digit());
        let number = &behind[..behind.len() - next.len()];
        let number = if number.is_empty() { 1 } else { number.parse().ok()? };
        composition.push((symbol.parse().ok()?, number));
        rest = next;
    }
    Some(composition)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_formula_is_parsed_into_elements_and_counts() {
        let found = |formula: &str| {
            let composition = composition(formula)?.into_iter();
            Some(composition.map(|(species, number)| (species.symbol(), number)).collect::<Vec<_>>())
        };
        assert_eq!(found("CHO2Si31").unwrap(), [("C", 1), ("H", 1), ("O", 2), ("Si", 31)]);
        assert_eq!(found("Co64").unwrap(), [("Co", 64)]);
        assert_eq!(found("").unwrap(), []);
        for wrong in ["2", "si2", "Xx2", "Si99999999999", "Sï"] {
            assert_eq!(found(wrong), None, "{wrong}");
        }
    }
}
