//! How walks have ended, why, and what to change where they ended too early: pure, for all who show it.

use serde::Serialize;
use store::WalkStatus;

/// So few early ends are no pattern yet.
const FEW: u64 = 3;

/// Why a walk ended before it had made its steps or collected its structures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// Hotter than `guard.highest_temperature`.
    TooHot,
    /// An energy or force that is no number.
    NotFinite,
    /// An atom without a neighbour.
    LostAtom,
    /// It cost several walkers.
    Crashed,
    /// The guard against short bonds refused it again and again.
    Trapped,
    /// The seed structure cannot be walked from.
    BadStart,
    /// Any other.
    Other,
}

/// Walks that ended in one way.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EndCount {
    /// As the store has it: `steps`, `collected`, `budget`, `trapped`, `blew_up`, `bad_start`.
    pub end: String,
    /// None of an end in order.
    pub cause: Option<Cause>,
    /// How many.
    pub walks: u64,
    /// Number of the first of them.
    pub walk: u32,
    /// Why that one ended, in words.
    pub reason: String,
    /// What to change.
    pub advice: Option<&'static str>,
}

/// How the walks of a campaign have ended.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Ends(Vec<EndCount>);

/// Why a walk with this state and reason ended early; none of one that is under way, or ended in order: it made all its steps,
/// collected all it may, or a budget was used up.
pub fn cause(state: &str, reason: &str) -> Option<Cause> {
    let has = |words: &str| reason.contains(words);
    match state {
        "waiting" | "running" | "steps" | "collected" | "budget" => None,
        "trapped" => Some(Cause::Trapped),
        _ if has("walkers crashed") || has("walker crashed") => Some(Cause::Crashed),
        "bad_start" => Some(Cause::BadStart),
        _ if has("is above the allowed") => Some(Cause::TooHot),
        _ if has("not finite") => Some(Cause::NotFinite),
        _ if has("has no neighbour") => Some(Cause::LostAtom),
        _ => Some(Cause::Other),
    }
}

/// Whether walk after walk ends early: of `ended` walks so many that it is no accident.
fn is_pattern(ended: u64, early: u64) -> bool {
    early >= FEW && 2 * early >= ended
}

impl Cause {
    /// In a few words.
    pub fn in_words(self) -> &'static str {
        match self {
            Self::TooHot => "too hot",
            Self::NotFinite => "forces are no numbers",
            Self::LostAtom => "an atom left the others",
            Self::Crashed => "walkers crashed",
            Self::Trapped => "atoms too close again and again",
            Self::BadStart => "no walk can start there",
            Self::Other => "diverged",
        }
    }

    /// What to change.
    pub fn advice(self) -> &'static str {
        match self {
            Self::TooHot => "a smaller walk.time_step or walk.tau, or guard.zbl",
            Self::NotFinite => "guard.zbl, a smaller walk.time_step or walk.tau",
            Self::LostAtom => "a smaller walk.tau, a narrower walk.volume_ramp or a lower walk.temperature",
            Self::Crashed => {
                "nothing in the configuration: see the walkers' last words in the log, and whether there is enough memory"
            }
            Self::Trapped => "a smaller walk.tau, or guard.zbl; guard.least_distance says what is too close",
            Self::BadStart => "the seed structure: the reason says what is wrong with it",
            Self::Other => "a smaller walk.time_step or walk.tau, or guard.zbl",
        }
    }
}

impl Ends {
    /// Of these walks; those that are under way are not counted.
    pub fn of(walks: &[WalkStatus]) -> Self {
        let mut ends = Self::default();
        for walk in walks.iter().filter(|walk| !walk.is_active()) {
            ends.add(walk.walk, &walk.state, &walk.reason);
        }
        ends
    }

    /// Counts a walk that has ended.
    pub fn add(&mut self, walk: u32, end: &str, reason: &str) {
        let cause = cause(end, reason);
        if let Some(count) = self.0.iter_mut().find(|count| count.end == end && count.cause == cause) {
            count.walks += 1;
            return;
        }
        let advice = cause.map(Cause::advice);
        self.0.push(EndCount { end: end.into(), cause, walks: 1, walk, reason: reason.into(), advice });
        self.0.sort_by(|a, b| (a.cause, &a.end).cmp(&(b.cause, &b.end)));
    }

    /// Walks that have ended.
    pub fn ended(&self) -> u64 {
        self.0.iter().map(|count| count.walks).sum()
    }

    /// Walks that have ended early.
    pub fn early(&self) -> u64 {
        self.causes().map(|(_, count)| count.walks).sum()
    }

    /// Whether walks have ended, and every one of them early.
    pub fn none_in_order(&self) -> bool {
        self.ended() > 0 && self.early() == self.ended()
    }

    /// Early ends, by cause.
    pub fn causes(&self) -> impl Iterator<Item = (Cause, &EndCount)> {
        self.0.iter().filter_map(|count| Some((count.cause?, count)))
    }

    /// All of them in one line: `12 collected, 3 blew up (too hot)`.
    pub fn in_words(&self) -> String {
        let one = |EndCount { end, cause, walks, .. }: &EndCount| {
            let end = end.replace('_', " ");
            match cause {
                Some(cause) if *cause != Cause::Trapped => format!("{walks} {end} ({})", cause.in_words()),
                _ => format!("{walks} {end}"),
            }
        };
        self.0.iter().map(one).collect::<Vec<_>>().join(", ")
    }

    /// The same without causes: `12 collected, 3 blew up`.
    pub fn without_causes(&self) -> String {
        let mut numbers: Vec<(&str, u64)> = Vec::new();
        for EndCount { end, walks, .. } in &self.0 {
            match numbers.iter_mut().find(|(known, _)| known == end) {
                Some((_, number)) => *number += walks,
                None => numbers.push((end, *walks)),
            }
        }
        let one = |(end, number): (&str, u64)| format!("{number} {}", end.replace('_', " "));
        numbers.into_iter().map(one).collect::<Vec<_>>().join(", ")
    }

    /// Whether walk after walk ends early.
    pub fn are_alarming(&self) -> bool {
        is_pattern(self.ended(), self.early())
    }

    /// The early ends and what to change, two lines a cause.
    pub fn lines(&self) -> Vec<String> {
        let two = |(cause, EndCount { walks, walk, reason, .. }): (Cause, &EndCount)| {
            let what = format!("{walks} {}, as walk {walk}: {reason}", cause.in_words());
            [what, format!("  what to change: {}", cause.advice())]
        };
        self.causes().flat_map(two).collect()
    }

    /// What a warning says of the early ends.
    pub fn warning(&self) -> String {
        let causes: Vec<_> =
            self.causes().map(|(cause, count)| format!("{} {}", count.walks, cause.in_words())).collect();
        let advice =
            self.causes().max_by_key(|(_, count)| count.walks).map_or("", |(cause, _)| cause.advice());
        let (early, ended) = (self.early(), self.ended());
        format!(
            "{early} of {ended} walks that have ended did so early ({}); what to change: {advice}",
            causes.join(", ")
        )
    }
}

#[cfg(test)]
mod tests {
    use atoms::{Cell, Evaluation, NeighbourList, Structure};
    use workers::guard::blown_up;
    use workers::settings::GuardSettings;

    use super::*;

    fn walk(number: u32, state: &str, reason: &str) -> WalkStatus {
        WalkStatus { walk: number, state: state.into(), reason: reason.into(), ..WalkStatus::default() }
    }

    #[test]
    fn what_the_guard_says_is_understood() {
        let settings = GuardSettings {
            least_distance: 1.2,
            least_distance_fraction: 0.75,
            highest_temperature: 1000.0,
            refusals_in_a_row: 10,
            most_returns: 3,
            tau_factor: 0.5,
            checkpoint_interval: 100,
        };
        let pair = |distance: f64| Structure {
            species: vec!["Al".parse().unwrap(); 2],
            positions: vec![[0.0; 3], [distance, 0.0, 0.0]],
            cell: Cell::orthorhombic(50.0, 50.0, 50.0),
            periodic: [true; 3],
        };
        let said = |distance, force, temperature| {
            let structure = pair(distance);
            let mut neighbours = NeighbourList::new(5.0, 0.0);
            neighbours.update(&structure).unwrap();
            let evaluation = Evaluation { forces: vec![[force; 3]; 2], ..Evaluation::default() };
            blown_up(&settings, &structure, &neighbours, &evaluation, temperature).unwrap()
        };
        for (reason, expected) in [
            (said(2.0, 0.0, 2000.0), Cause::TooHot),
            (said(2.0, f64::NAN, 300.0), Cause::NotFinite),
            (said(20.0, 0.0, 300.0), Cause::LostAtom),
        ] {
            assert_eq!(cause("blew_up", &format!("at step 3: {reason}")), Some(expected), "{reason}");
        }
        assert_eq!(cause("blew_up", "4 walkers crashed in this turn"), Some(Cause::Crashed));
        assert_eq!(cause("bad_start", "an element that the model does not know"), Some(Cause::BadStart));
        assert_eq!(cause("running", ""), None);
    }

    #[test]
    fn ends_are_counted_by_cause() {
        let walks = [
            walk(0, "collected", ""),
            walk(1, "running", ""),
            walk(2, "blew_up", "at step 5: 9000 K is above the allowed 800 K"),
            walk(3, "blew_up", "at step 7: 9999 K is above the allowed 800 K"),
            walk(4, "trapped", "refused by the shortest-bond guard again and again"),
            walk(5, "collected", ""),
        ];
        let ends = Ends::of(&walks);
        assert_eq!((ends.ended(), ends.early(), ends.none_in_order()), (5, 3, false));
        assert_eq!(ends.in_words(), "2 collected, 2 blew up (too hot), 1 trapped");
        assert_eq!(ends.without_causes(), "2 collected, 2 blew up, 1 trapped");
        let (_, hot) = ends.causes().next().unwrap();
        assert_eq!((hot.walk, hot.reason.as_str()), (2, "at step 5: 9000 K is above the allowed 800 K"));
        assert!(ends.warning().starts_with("3 of 5 walks that have ended did so early (2 too hot, 1 atoms"));
        assert!(Ends::of(&walks[2..5]).none_in_order() && !Ends::of(&walks[1..2]).none_in_order());
    }

    #[test]
    fn walk_after_walk_is_more_than_an_accident() {
        for (ended, early, expected) in
            [(0, 0, false), (2, 2, false), (3, 3, true), (6, 3, true), (7, 3, false), (100, 50, true)]
        {
            assert_eq!(is_pattern(ended, early), expected, "{early} of {ended}");
        }
    }
}
