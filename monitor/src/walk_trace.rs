//! The trace of one walk, with what it is compared with. docs/walk-diagnostics.md describes the JSON form.

use calm::CollectionRule;
use serde::Serialize;
use serde_json::Value;
use store::{Store, StoreError};
use wire::{TracePoint, WalkConditions, WalkId};

/// Version of the JSON form. Adding fields keeps the version; removing or changing them increments it.
pub const FORMAT: u32 = 1;

/// The trace of a walk.
#[derive(Clone, Debug, Serialize)]
pub struct WalkTrace {
    /// [`FORMAT`].
    pub format: u32,
    /// Number of the walk.
    pub walk: u32,
    /// Name of its seed structure.
    pub seed_structure: String,
    /// `biased` or `control`.
    pub origin: String,
    /// `waiting`, `running`, or how it ended.
    pub state: String,
    /// Its conditions; `None` in campaigns of early versions.
    pub conditions: Option<WalkConditions>,
    /// The γ above which atoms count for the collection rule, unless a long label queue raises it.
    pub threshold: Option<f64>,
    /// Its points in order.
    pub points: Vec<TracePoint>,
}

impl WalkTrace {
    /// Reads the trace of a walk.
    ///
    /// # Errors
    /// [`StoreError::UnknownWalk`], or the store cannot be read.
    pub async fn read(store: &Store, walk: WalkId) -> Result<Self, StoreError> {
        let Some((status, _)) = store.walk(walk).await? else {
            let walks = store.status().await?.walks.len() as u64;
            return Err(StoreError::UnknownWalk { walk, walks });
        };
        Ok(Self {
            format: FORMAT,
            walk: status.walk,
            seed_structure: status.seed_structure,
            origin: status.origin,
            state: status.state,
            conditions: store.walk_conditions().await?.remove(&walk),
            threshold: threshold(&store.campaign().await?.configuration_in_force),
            points: store.walk_trace(walk).await?,
        })
    }
}

/// The last point at or before a step of a segment; `None` if that segment has none.
pub fn point_before(points: &[TracePoint], segment: u32, step: u64) -> Option<&TracePoint> {
    points.iter().rfind(|point| point.segment == segment && point.step <= step)
}

/// The threshold of the collection rule of a configuration, JSON.
pub fn threshold(configuration: &str) -> Option<f64> {
    let configuration: Value = serde_json::from_str(configuration).ok()?;
    let rule: CollectionRule = serde_json::from_value(configuration["collect"]["criterion"].clone()).ok()?;
    Some(rule.threshold())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_point_before_a_step_is_of_its_segment() {
        let point = |segment, step| TracePoint { segment, step, ..TracePoint::default() };
        let points = [point(0, 0), point(0, 50), point(0, 100), point(1, 90), point(1, 140)];
        let found = |segment, step| point_before(&points, segment, step).map(|point| point.step);
        assert_eq!([found(0, 49), found(0, 50), found(0, 99)], [Some(0), Some(50), Some(50)]);
        assert_eq!(
            [found(1, 89), found(1, 100), found(1, 999), found(2, 999)],
            [None, Some(90), Some(140), None]
        );
    }

    #[test]
    fn the_threshold_is_that_of_the_collection_rule() {
        let rule = r#"{"collect":{"criterion":{"rule":"maximum_grade","threshold":1.25}}}"#;
        assert_eq!(threshold(rule), Some(1.25));
        assert_eq!(threshold("{}"), None);
    }
}
