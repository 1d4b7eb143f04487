//! Counts how walks ended and why, and gives advice on early ends.

use serde::Serialize;
use store::WalkStatus;

/// Fewer early ends are not a pattern yet.
const MIN_EARLY_ENDS: u64 = 3;

/// Why a walk ended before it made all its steps or collected all its structures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EarlyEndCause {
    /// The temperature exceeded `guard.max_temperature`.
    TooHot,
    /// An energy or force is not finite.
    NotFinite,
    /// An atom has no neighbour.
    LostAtom,
    /// The walk crashed several walkers.
    Crashed,
    /// The shortest-bond guard rejected its structures repeatedly.
    Trapped,
    /// Its structures were repeatedly above `guard.max_grade`.
    BeyondGrade,
    /// A cell with a barostat changed too fast or too far.
    UnstableCell,
    /// No walk can start from the seed structure.
    InvalidStart,
    /// Any other cause.
    Other,
}

/// The walks that ended in one way.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EndCount {
    /// `completed`, `quota_reached`, `budget`, `superseded`, `nothing_new`, `volume_boundary`, `trapped`, `diverged` or `invalid_start`.
    pub end: String,
    /// `None` if the walks did not end early.
    pub cause: Option<EarlyEndCause>,
    /// Number of walks.
    pub walks: u64,
    /// Number of the first of these walks.
    pub walk: u32,
    /// Why that walk ended, as text.
    pub reason: String,
    /// What to change.
    pub advice: Option<&'static str>,
}

/// How the walks of a campaign ended.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(transparent)]
pub struct WalkEnds(Vec<EndCount>);

/// Why a walk with this state and reason ended early. `None` for a walk that is running, made all its steps,
/// collected all it may, or ended with all others: by a limit, or for a new version.
pub fn early_end_cause(state: &str, reason: &str) -> Option<EarlyEndCause> {
    let has = |words: &str| reason.contains(words);
    match state {
        "waiting" | "running" | "completed" | "quota_reached" | "budget" | "superseded" | "nothing_new"
        | "volume_boundary" => None,
        "trapped" if has("largest-grade") => Some(EarlyEndCause::BeyondGrade),
        "trapped" => Some(EarlyEndCause::Trapped),
        _ if has("walkers crashed") || has("walker crashed") => Some(EarlyEndCause::Crashed),
        "invalid_start" => Some(EarlyEndCause::InvalidStart),
        _ if has("is above the allowed") => Some(EarlyEndCause::TooHot),
        _ if has("the cell changes by") || has("the volume is") => Some(EarlyEndCause::UnstableCell),
        _ if has("not finite") => Some(EarlyEndCause::NotFinite),
        _ if has("has no neighbour") => Some(EarlyEndCause::LostAtom),
        _ => Some(EarlyEndCause::Other),
    }
}

/// Whether `early` of `ended` walks are too many to be accidents.
fn is_pattern(ended: u64, early: u64) -> bool {
    early >= MIN_EARLY_ENDS && 2 * early >= ended
}

impl EarlyEndCause {
    /// What to change.
    pub fn advice(self) -> &'static str {
        match self {
            Self::TooHot => "a smaller walk.time_step or walk.tau, or guard.zbl",
            Self::NotFinite => "guard.zbl, a smaller walk.time_step or walk.tau",
            Self::LostAtom => "a smaller walk.tau, a narrower walk.volume_ramp or a lower walk.temperature",
            Self::Crashed => {
                "nothing in the configuration: check the walkers' last output in the log, and the free memory"
            }
            Self::Trapped => "a smaller walk.tau, or guard.zbl; guard.min_distances says what is too close",
            Self::BeyondGrade => "a larger guard.max_grade, or a smaller walk.tau",
            Self::UnstableCell => {
                "walk.barostat.pressure, a longer walk.barostat.relaxation_time, smaller gains in walk.cell_bias.gain_range, or a \
                 walk.start_volume closer to 1"
            }
            Self::InvalidStart => "the seed structure: the reason says what is wrong with it",
            Self::Other => "a smaller walk.time_step or walk.tau, or guard.zbl",
        }
    }
}

impl WalkEnds {
    /// Counts these walks, except those that are running.
    pub fn from_walks(walks: &[WalkStatus]) -> Self {
        let mut ends = Self::default();
        for walk in walks.iter().filter(|walk| !walk.is_active()) {
            ends.add(walk.walk, &walk.state, &walk.reason);
        }
        ends
    }

    /// Counts a walk that has ended.
    pub fn add(&mut self, walk: u32, end: &str, reason: &str) {
        let cause = early_end_cause(end, reason);
        if let Some(count) = self.0.iter_mut().find(|count| count.end == end && count.cause == cause) {
            count.walks += 1;
            return;
        }
        let advice = cause.map(EarlyEndCause::advice);
        self.0.push(EndCount { end: end.into(), cause, walks: 1, walk, reason: reason.into(), advice });
        self.0.sort_by(|a, b| (a.cause, &a.end).cmp(&(b.cause, &b.end)));
    }

    /// All ends, by cause.
    pub fn counts(&self) -> &[EndCount] {
        &self.0
    }

    /// Number of walks that have ended.
    pub fn ended(&self) -> u64 {
        self.0.iter().map(|count| count.walks).sum()
    }

    /// Number of walks that ended early.
    pub fn early(&self) -> u64 {
        self.causes().map(|(_, count)| count.walks).sum()
    }

    /// Whether walks have ended, and all of them early.
    pub fn all_early(&self) -> bool {
        self.ended() > 0 && self.early() == self.ended()
    }

    /// Early ends, by cause.
    pub fn causes(&self) -> impl Iterator<Item = (EarlyEndCause, &EndCount)> {
        self.0.iter().filter_map(|count| Some((count.cause?, count)))
    }

    /// Whether many walks ended early.
    pub fn is_alarming(&self) -> bool {
        is_pattern(self.ended(), self.early())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn walk(number: u32, state: &str, reason: &str) -> WalkStatus {
        WalkStatus { walk: number, state: state.into(), reason: reason.into(), ..WalkStatus::default() }
    }

    #[test]
    fn ends_are_counted_by_cause() {
        let walks = [
            walk(0, "quota_reached", ""),
            walk(1, "running", ""),
            walk(2, "diverged", "at step 5: 9000 K is above the allowed 800 K"),
            walk(3, "diverged", "at step 7: 9999 K is above the allowed 800 K"),
            walk(4, "trapped", "rejected by the shortest-bond guard again and again"),
            walk(5, "quota_reached", ""),
        ];
        let ends = WalkEnds::from_walks(&walks);
        assert_eq!((ends.ended(), ends.early(), ends.all_early()), (5, 3, false));
        let (_, hot) = ends.causes().next().unwrap();
        assert_eq!((hot.walk, hot.reason.as_str()), (2, "at step 5: 9000 K is above the allowed 800 K"));
        assert!(
            WalkEnds::from_walks(&walks[2..5]).all_early() && !WalkEnds::from_walks(&walks[1..2]).all_early()
        );
    }

    #[test]
    fn causes_other_than_reasons_of_the_guard() {
        let crashed = early_end_cause("diverged", "4 walkers crashed in this assignment");
        assert_eq!(crashed, Some(EarlyEndCause::Crashed));
        let start = early_end_cause("invalid_start", "an element that the model does not know");
        assert_eq!(start, Some(EarlyEndCause::InvalidStart));
        assert_eq!(early_end_cause("running", ""), None);
    }

    #[test]
    fn many_early_ends_are_a_pattern() {
        for (ended, early, expected) in
            [(0, 0, false), (2, 2, false), (3, 3, true), (6, 3, true), (7, 3, false), (100, 50, true)]
        {
            assert_eq!(is_pattern(ended, early), expected, "{early} of {ended}");
        }
    }
}
