//! Lists of decisions in queries, so that many rows cost few queries.

use crate::database::SqlValue;

/// Number of decisions in a list.
pub const LENGTH: usize = 32;

/// A list as SQL: the bound values from `$2` on.
macro_rules! decision_list {
    () => {
        "($2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15, $16, $17, $18, $19, $20, $21, $22, $23, $24, $25, $26,
        $27, $28, $29, $30, $31, $32, $33)"
    };
}
pub(crate) use decision_list;

/// The values of each list: at most [`LENGTH`] decisions, of which the last is repeated if there are fewer.
pub fn lists(decisions: &[i64]) -> impl Iterator<Item = Vec<SqlValue>> {
    decisions.chunks(LENGTH).map(|some| {
        let last = some.last().copied().unwrap_or_default();
        some.iter().copied().chain(std::iter::repeat(last)).take(LENGTH).map(SqlValue::from).collect()
    })
}
