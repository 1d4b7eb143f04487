//! The parameters of a request: which candidates, in which order, and from where on.

use std::str::FromStr;

use store::{JobState, ListCursor};

use super::MAX_PAGE_ROWS;
use super::columns::SortColumn;
use crate::filter::StructureFilter;
use crate::web::dashboard::response::ApiError;

/// Parameters of a request.
#[derive(Debug, Default)]
pub(super) struct CandidateQuery {
    pub order: TableOrder,
    pub ascending: bool,
    pub fate: Option<String>,
    pub state: Option<JobState>,
    pub filter: Option<StructureFilter>,
    pub after: Option<PagePlace>,
    pub limit: Option<u32>,
}

/// Order of the rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum TableOrder {
    #[default]
    Decision,
    Gamma,
    RelativeVolume,
    /// Order in which the jobs of one state would be labelled.
    Queue,
    /// By a column that has no index.
    Column(SortColumn),
}

/// Where a page begins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum PagePlace {
    /// Behind a row, in an order that has an index.
    Behind(ListCursor),
    /// Behind this many rows, in any other order.
    Rows(usize),
}

impl CandidateQuery {
    /// The parameters of an address.
    pub fn parse(text: &str) -> Result<Self, ApiError> {
        let mut query = Self::default();
        for (key, value) in form_urlencoded::parse(text.as_bytes()).filter(|(_, value)| !value.is_empty()) {
            query.set(&key, &value)?;
        }
        if query.order == TableOrder::Queue && query.state.is_none() {
            return Err(ApiError::bad_request("the order 'queue' applies to one state: give 'state' too"));
        }
        let by_column = matches!(query.order, TableOrder::Column(_));
        if query.after.is_some_and(|after| by_column != matches!(after, PagePlace::Rows(_))) {
            return Err(ApiError::bad_request("after is of another order"));
        }
        Ok(query)
    }

    fn set(&mut self, key: &str, value: &str) -> Result<(), ApiError> {
        match key {
            "order" => self.order = value.parse()?,
            "ascending" => self.ascending = value == "true",
            "fate" => self.fate = Some(value.to_owned()),
            "state" => {
                let unknown =
                    || ApiError::bad_request(format!("state is '{value}', expected a state of label jobs"));
                self.state = Some(JobState::named(value).ok_or_else(unknown)?);
            }
            "where" => self.filter = Some(filter(value)?),
            "after" => self.after = Some(value.parse()?),
            "limit" => {
                let wrong =
                    || ApiError::bad_request(format!("limit is '{value}', expected 1 to {MAX_PAGE_ROWS}"));
                let limit = value.parse().ok().filter(|limit| (1..=MAX_PAGE_ROWS).contains(limit));
                self.limit = Some(limit.ok_or_else(wrong)?);
            }
            _ => return Err(ApiError::bad_request(format!("unknown parameter '{key}'"))),
        }
        Ok(())
    }

    /// Where a page begins whose order has an index.
    pub fn cursor(&self) -> Option<ListCursor> {
        match self.after {
            Some(PagePlace::Behind(cursor)) => Some(cursor),
            _ => None,
        }
    }
}

/// The filter of this text, if the table has the properties that it names.
fn filter(text: &str) -> Result<StructureFilter, ApiError> {
    let filter: StructureFilter = text.parse().map_err(ApiError::bad_request)?;
    // Such a comparison would be false for all candidates.
    if filter.names().contains(&"fragments") {
        return Err(ApiError::bad_request(
            "the table does not know 'fragments', which needs positions: use calmwalk export --where",
        ));
    }
    Ok(filter)
}

impl FromStr for TableOrder {
    type Err = ApiError;

    fn from_str(name: &str) -> Result<Self, ApiError> {
        match name {
            "decision" => Ok(Self::Decision),
            "gamma" => Ok(Self::Gamma),
            "relative_volume" => Ok(Self::RelativeVolume),
            "queue" => Ok(Self::Queue),
            _ => SortColumn::named(name).map(Self::Column).ok_or_else(|| {
                ApiError::bad_request(format!(
                    "order is '{name}', expected one of decision, gamma, relative_volume, queue, {}",
                    SortColumn::names().join(", ")
                ))
            }),
        }
    }
}

impl PagePlace {
    /// The text that [`Self::from_str`] reads.
    pub fn text(self) -> String {
        match self {
            Self::Behind(place) => format!("{:?}:{}:{}", place.value, place.decision, place.priority),
            Self::Rows(number) => format!("rows:{number}"),
        }
    }
}

impl FromStr for PagePlace {
    type Err = ApiError;

    fn from_str(text: &str) -> Result<Self, ApiError> {
        let cursor = |(value, place): (&str, &str)| {
            let value = value.parse().ok().filter(|value: &f64| value.is_finite())?;
            let (decision, priority) = place.split_once(':')?;
            let (decision, priority) = (decision.parse().ok()?, priority.parse().ok()?);
            Some(Self::Behind(ListCursor { priority, value, decision }))
        };
        let read = |(first, rest): (&str, &str)| match first {
            "rows" => rest.parse().ok().map(Self::Rows),
            _ => cursor((first, rest)),
        };
        let wrong =
            || ApiError::bad_request(format!("after is '{text}', expected 'next' of the previous page"));
        text.split_once(':').and_then(read).ok_or_else(wrong)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queries_are_parsed_or_refused_with_a_reason() {
        let query =
            CandidateQuery::parse("order=gamma&ascending=true&fate=&where=gamma+%3E+2&after=2.5:17:10")
                .unwrap();
        assert!(query.order == TableOrder::Gamma && query.ascending && query.fate.is_none());
        assert_eq!(query.filter.as_ref().unwrap().to_string(), "gamma > 2.0");
        assert_eq!(query.cursor(), Some(ListCursor { priority: 10, value: 2.5, decision: 17 }));
        let query = CandidateQuery::parse("order=force_mae&after=rows:50").unwrap();
        assert_eq!(query.after.map(PagePlace::text), Some("rows:50".to_owned()));
        for (query, why) in [
            ("order=size", "expected one of decision"),
            ("order=queue", "give 'state'"),
            ("limit=0", "expected 1 to 200"),
            ("after=NaN:1", "expected 'next'"),
            ("order=atoms&after=rows:-1", "expected 'next'"),
            ("order=atoms&after=2.5:17:10", "of another order"),
            ("order=gamma&after=rows:2", "of another order"),
            ("where=gamma", "expected one of = != <"),
            ("where=gamma+%3E+1+or+not+fragments+%3D+1", "does not know 'fragments'"),
            ("sort=gamma", "unknown parameter 'sort'"),
        ] {
            let refused = format!("{:?}", CandidateQuery::parse(query).unwrap_err());
            assert!(refused.contains(why), "{query}: {refused}");
        }
    }
}
