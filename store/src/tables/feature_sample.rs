//! An even sample of the collected structures, and what places them in feature space.

use std::ops::Range;

use wire::{ContentHash, Origin};

use super::decision_list::{decision_list, lists};
use super::report::{collected, job_and_forces, protocol_number};
use super::restore::{block, grades};
use crate::Store;
use crate::checksum::{CANDIDATE, LONG_COLUMNS, Names, joined};
use crate::database::{FromRow, SqlRow, query};
use crate::error::Result;
use crate::numbers::decode_numbers;
use crate::report::{CollectedFeatures, DecisionSample};

macro_rules! accepted {
    ($what:literal, $which:literal) => {
        concat!(
            "SELECT ",
            $what,
            " FROM candidate WHERE origin = $1 AND fate = 'accepted' AND reason IS NULL",
            $which
        )
    };
}

pub(crate) const NUMBER: &str = accepted!("count(*)", "");
const NUMBER_OF_WALKS: &str = accepted!("count(*)", " AND walk >= $2 AND walk < $3");

/// Multiples of 0.618033, about the golden ratio, modulo 1 fill the interval evenly, whatever the period in which walks take turns. Those
/// of decisions below a share of the interval are this share of them.
pub(crate) const SAMPLED: &str = accepted!(
    "decision",
    " AND decision * 618033 % 1000000 < $2 AND walk >= $3 AND walk < $4 ORDER BY decision"
);
/// The share that is all.
const ALL: i64 = 1_000_000;

pub(crate) const FEATURES: &str = collected!(
    "features_checksum, selector_checksum, features, selector_grades, ",
    concat!("IN ", decision_list!(), " ORDER BY candidate.decision")
);

impl Store {
    /// Decisions on about `room` accepted candidates, or frames of control walks, of these walks, evenly spread over the decision
    /// log; all of them if there are no more than that.
    pub async fn sampled_decisions(
        &self,
        origin: Origin,
        walks: Range<i64>,
        room: u32,
    ) -> Result<DecisionSample> {
        let number = match walks == (0..i64::MAX) {
            // The index has the answer.
            true => query(NUMBER).bind(origin.name()),
            false => query(NUMBER_OF_WALKS).bind(origin.name()).bind(walks.start).bind(walks.end),
        };
        let total: i64 = number.fetch_one(&self.database).await?;
        let share = (ALL * i64::from(room)).checked_div(total).map_or(ALL, |share| share.min(ALL));
        let sampled = query(SAMPLED).bind(origin.name()).bind(share).bind(walks.start).bind(walks.end);
        let decisions = sampled.fetch_all(&self.database).await?;
        Ok(DecisionSample { total: total.unsigned_abs(), decisions })
    }

    /// The candidates of these decisions, in decision order, with their labels under `protocol`.
    pub async fn collected_features(
        &self,
        protocol: Option<ContentHash>,
        decisions: &[i64],
    ) -> Result<Vec<CollectedFeatures>> {
        let mut transaction = self.database.begin_read().await?;
        let number = protocol_number(&mut transaction, protocol).await?;
        let mut found = Vec::new();
        for list in lists(decisions) {
            let page = query(FEATURES).bind(number).bind_all(list);
            found.extend(page.fetch_all::<CollectedFeatures>(&mut transaction).await?);
        }
        transaction.commit().await?;
        Ok(found)
    }
}

impl FromRow for CollectedFeatures {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Joined)?;
        LONG_COLUMNS.iter().try_for_each(|column| column.verify(row))?;
        let features = row.bytes("features")?.map(decode_numbers);
        Ok(Self {
            decision: row.get("decision")?,
            block: block(row, &row.get::<String>("candidate__id")?)?,
            features: features.transpose()?,
            selector: grades(row.bytes("selector_grades")?)?,
            original: grades(row.bytes("original_grades")?)?,
            label_forces: job_and_forces(row)?.1,
        })
    }
}
