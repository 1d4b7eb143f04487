//! The table of candidates, a page at a time. However many there are, an answer looks at a bounded number of them: where
//! a condition finds few, it says how far it came, and from where to go on.

use std::collections::HashMap;
use std::str::FromStr;

use atoms::Species;
use axum::extract::{RawQuery, State};
use serde_json::json;
use store::{JobState, ListCursor, ListOrder, ListedCandidate, Store, StoreError};

use super::Dashboard;
use super::answer::{Answer, Refusal, json};
use crate::condition::{Condition, Facts, species};

/// Lines of a page, at most.
const LONGEST: u32 = 200;
/// Candidates read at a time where some are left out, and looked at for an answer.
const WINDOW: u32 = 1000;
const LOOKED: usize = 10_000;

/// What is asked for.
#[derive(Debug, Default)]
struct Asked {
    order: Order,
    ascending: bool,
    fate: Option<String>,
    state: Option<JobState>,
    condition: Option<Condition>,
    after: Option<ListCursor>,
    limit: Option<u32>,
}

/// By what the lines are in order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Order {
    #[default]
    Decision,
    Gamma,
    Volume,
    /// In which the jobs of one state would be labelled.
    Queue,
}

/// A page of the table.
#[derive(Debug, Default)]
struct Page {
    lines: Vec<ListedCandidate>,
    /// Where the next page begins; none at the end.
    next: Option<ListCursor>,
    looked: usize,
}

/// `GET /api/candidates?order=…&ascending=…&fate=…&state=…&where=…&after=…&limit=…`
pub async fn page(State(dashboard): State<Dashboard>, RawQuery(query): RawQuery) -> Answer {
    let asked = Asked::read(query.as_deref().unwrap_or_default())?;
    let Page { lines, next, looked } = asked.page(&dashboard.store).await?;
    let next = next.map(|place| format!("{:?}:{}", place.value, place.decision));
    json(&json!({ "candidates": lines, "next": next, "looked_at": looked }))
}

impl Asked {
    fn read(query: &str) -> Result<Self, Refusal> {
        let mut asked = Self::default();
        for (key, value) in form_urlencoded::parse(query.as_bytes()).filter(|(_, value)| !value.is_empty()) {
            match key.as_ref() {
                "order" => asked.order = value.parse()?,
                "ascending" => asked.ascending = value == "true",
                "fate" => asked.fate = Some(value.into_owned()),
                "state" => {
                    let unknown =
                        || Refusal::wrong(format!("state is '{value}', expected one of a label job"));
                    asked.state = Some(JobState::named(&value).ok_or_else(unknown)?);
                }
                "where" => asked.condition = Some(value.parse().map_err(Refusal::wrong)?),
                "after" => asked.after = Some(place(&value)?),
                "limit" => {
                    let wrong = || Refusal::wrong(format!("limit is '{value}', expected 1 to {LONGEST}"));
                    let limit = value.parse().ok().filter(|limit| (1..=LONGEST).contains(limit));
                    asked.limit = Some(limit.ok_or_else(wrong)?);
                }
                _ => return Err(Refusal::wrong(format!("there is no parameter '{key}'"))),
            }
        }
        if asked.order == Order::Queue && asked.state.is_none() {
            return Err(Refusal::wrong("the order of the queue is that of one state: give 'state' too"));
        }
        Ok(asked)
    }

    async fn page(&self, store: &Store) -> Result<Page, StoreError> {
        let limit = self.limit.unwrap_or(50);
        let window = if self.leaves_some_out() { WINDOW } else { limit };
        let (mut page, mut place, mut elements) = (Page::default(), self.after, HashMap::new());
        loop {
            let lines = self.lines(store, place, window).await?;
            let is_last = lines.len() < window as usize;
            for line in lines {
                page.looked += 1;
                place = Some(self.place_of(&line));
                if self.wants(&line, &mut elements) {
                    page.lines.push(line);
                }
                if page.lines.len() == limit as usize {
                    page.next = place;
                    return Ok(page);
                }
            }
            if is_last || page.looked >= LOOKED {
                page.next = place.filter(|_| !is_last);
                return Ok(page);
            }
        }
    }

    /// Whether what is read holds more than what is wanted.
    fn leaves_some_out(&self) -> bool {
        let by_fate = self.fate.is_some() && self.order != Order::Decision;
        let by_state = self.state.is_some() && self.order != Order::Queue;
        by_fate || by_state || self.condition.is_some()
    }

    async fn lines(
        &self,
        store: &Store,
        after: Option<ListCursor>,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>, StoreError> {
        let descending = !self.ascending;
        let order = match (self.order, self.state, self.fate.as_deref()) {
            (Order::Queue, Some(state), _) => {
                let after = after.map(|place| (place.value as i32, place.decision));
                return store.list_queue(state, after, limit).await;
            }
            (Order::Decision, _, Some(fate)) => {
                let (origin, reason) = match fate {
                    "control" => ("control", None),
                    "accepted" => ("biased", None),
                    reason => ("biased", Some(reason)),
                };
                let after = after.map(|place| place.decision);
                return store.list_fate(origin, reason, descending, after, limit).await;
            }
            (Order::Gamma, ..) => ListOrder::Gamma,
            (Order::Volume, ..) => ListOrder::Volume,
            (Order::Decision | Order::Queue, ..) => ListOrder::Decision,
        };
        store.list_candidates(order, descending, after, limit).await
    }

    fn place_of(&self, line: &ListedCandidate) -> ListCursor {
        let value = match self.order {
            Order::Decision => None,
            Order::Gamma => line.gamma,
            Order::Volume => line.relative_volume,
            Order::Queue => line.priority.map(f64::from),
        };
        ListCursor { value: value.unwrap_or_default(), decision: line.decision }
    }

    /// `elements`: those of formulas that were met before.
    fn wants(&self, line: &ListedCandidate, elements: &mut HashMap<String, Vec<Species>>) -> bool {
        let fate = if line.origin == "control" { "control" } else { &line.fate };
        if self.fate.as_deref().is_some_and(|wanted| wanted != fate) {
            return false;
        }
        if self.state.is_some_and(|wanted| line.job_state.as_deref() != Some(wanted.name())) {
            return false;
        }
        let Some(condition) = &self.condition else { return true };
        let species = elements.entry(line.formula.clone()).or_insert_with(|| species(&line.formula));
        condition.is_met(&facts(line, species))
    }
}

/// What a condition sees of a candidate: the same as that of `calmwalk export`.
fn facts<'a>(line: &'a ListedCandidate, species: &'a [Species]) -> Facts<'a> {
    Facts {
        gamma: line.gamma,
        gamma_nbr: line.gamma_nbr,
        volume: line.relative_volume,
        temperature: line.temperature,
        walk: Some(line.walk),
        step: Some(line.step),
        mixture_version: Some(line.mixture_version),
        energy: line.energy,
        max_force: line.max_force,
        species,
        kind: &line.origin,
        seed: Some(&line.seed_structure),
    }
}

impl FromStr for Order {
    type Err = Refusal;

    fn from_str(name: &str) -> Result<Self, Refusal> {
        match name {
            "decision" => Ok(Self::Decision),
            "gamma" => Ok(Self::Gamma),
            "volume" => Ok(Self::Volume),
            "queue" => Ok(Self::Queue),
            _ => Err(Refusal::wrong(format!(
                "order is '{name}', expected one of decision, gamma, volume, queue"
            ))),
        }
    }
}

fn place(text: &str) -> Result<ListCursor, Refusal> {
    let read = |(value, decision): (&str, &str)| {
        let value = value.parse().ok().filter(|value: &f64| value.is_finite())?;
        Some(ListCursor { value, decision: decision.parse().ok()? })
    };
    let wrong = || Refusal::wrong(format!("after is '{text}', expected what 'next' of the page before was"));
    text.split_once(':').and_then(read).ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formulas_are_atoms() {
        let symbols = |formula| species(formula).iter().map(|s| s.symbol()).collect::<Vec<_>>().join(" ");
        assert_eq!(symbols("Al3MoN2"), "Al Al Al Mo N N");
        assert_eq!(symbols("C"), "C");
        assert_eq!(symbols(""), "");
        assert_eq!(symbols("Xx2é9"), "");
    }

    #[test]
    fn what_is_asked_is_read_or_refused_with_a_reason() {
        let asked = Asked::read("order=gamma&ascending=true&fate=&where=gamma+%3E+2&after=2.5:17").unwrap();
        assert!(asked.order == Order::Gamma && asked.ascending && asked.fate.is_none());
        assert_eq!(asked.condition.unwrap().to_string(), "gamma > 2.0");
        assert_eq!(asked.after, Some(ListCursor { value: 2.5, decision: 17 }));
        for (query, why) in [
            ("order=size", "expected one of decision"),
            ("order=queue", "give 'state'"),
            ("limit=0", "expected 1 to 200"),
            ("after=NaN:1", "expected what 'next'"),
            ("where=gamma", "expected one of = != <"),
            ("sort=gamma", "no parameter 'sort'"),
        ] {
            let refused = format!("{:?}", Asked::read(query).unwrap_err());
            assert!(refused.contains(why), "{query}: {refused}");
        }
    }
}
