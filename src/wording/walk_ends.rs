//! How walks ended, in words.

use monitor::walk_ends::{EarlyEndCause, EndCount, WalkEnds};

/// Short description of a cause.
pub fn cause(cause: EarlyEndCause) -> &'static str {
    match cause {
        EarlyEndCause::TooHot => "too hot",
        EarlyEndCause::NotFinite => "forces not finite",
        EarlyEndCause::LostAtom => "an atom left the structure",
        EarlyEndCause::Crashed => "walkers crashed",
        EarlyEndCause::Trapped => "atoms repeatedly too close",
        EarlyEndCause::BeyondGrade => "grades repeatedly beyond the bound",
        EarlyEndCause::UnstableCell => "the cell was not stable",
        EarlyEndCause::InvalidStart => "invalid start",
        EarlyEndCause::Other => "other",
    }
}

/// All ends in one line: `12 quota reached, 3 diverged (too hot)`.
pub fn all(ends: &WalkEnds) -> String {
    let one = |EndCount { end, cause: why, walks, .. }: &EndCount| {
        let end = end.replace('_', " ");
        match why {
            Some(why) if *why != EarlyEndCause::Trapped && cause(*why) != end => {
                format!("{walks} {end} ({})", cause(*why))
            }
            _ => format!("{walks} {end}"),
        }
    };
    ends.counts().iter().map(one).collect::<Vec<_>>().join(", ")
}

/// All ends in one line without causes: `12 quota reached, 3 diverged`.
pub fn without_causes(ends: &WalkEnds) -> String {
    let mut numbers: Vec<(&str, u64)> = Vec::new();
    for EndCount { end, walks, .. } in ends.counts() {
        match numbers.iter_mut().find(|(known, _)| known == end) {
            Some((_, number)) => *number += walks,
            None => numbers.push((end, *walks)),
        }
    }
    let one = |(end, number): (&str, u64)| format!("{number} {}", end.replace('_', " "));
    numbers.into_iter().map(one).collect::<Vec<_>>().join(", ")
}

/// The early ends and what to change, two lines for each cause.
pub fn early_ends(ends: &WalkEnds) -> Vec<String> {
    let two = |(why, EndCount { walks, walk, reason, .. }): (EarlyEndCause, &EndCount)| {
        let what = format!("{walks} {}, such as walk {walk}: {reason}", cause(why));
        [what, format!("  what to change: {}", why.advice())]
    };
    ends.causes().flat_map(two).collect()
}

/// The warning about early ends.
pub fn warning(ends: &WalkEnds) -> String {
    let causes: Vec<_> =
        ends.causes().map(|(why, count)| format!("{} {}", count.walks, cause(why))).collect();
    let advice = ends.causes().max_by_key(|(_, count)| count.walks).map_or("", |(why, _)| why.advice());
    let (early, ended) = (ends.early(), ends.ended());
    format!("{early} of {ended} finished walks ended early ({}); what to change: {advice}", causes.join(", "))
}

#[cfg(test)]
mod tests {
    use atoms::{Cell, Evaluation, MinDistanceRule, NeighbourList, Structure};
    use monitor::walk_ends::early_end_cause;
    use store::WalkStatus;
    use workers::guard::blown_up;
    use workers::settings::GuardSettings;

    use super::*;

    #[test]
    fn reasons_of_the_guard_have_causes() {
        let settings = GuardSettings {
            min_distances: MinDistanceRule::default(),
            max_grade: None,
            max_temperature: 1000.0,
            rollback: true,
            max_consecutive_rejections: 10,
            max_rollbacks: 3,
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
            (said(2.0, 0.0, 2000.0), EarlyEndCause::TooHot),
            (said(2.0, f64::NAN, 300.0), EarlyEndCause::NotFinite),
            (said(20.0, 0.0, 300.0), EarlyEndCause::LostAtom),
        ] {
            assert_eq!(
                early_end_cause("diverged", &format!("at step 3: {reason}")),
                Some(expected),
                "{reason}"
            );
        }
    }

    #[test]
    fn ends_are_described_with_their_causes() {
        let walk = |number: u32, state: &str, reason: &str| WalkStatus {
            walk: number,
            state: state.into(),
            reason: reason.into(),
            ..WalkStatus::default()
        };
        let walks = [
            walk(0, "quota_reached", ""),
            walk(1, "running", ""),
            walk(2, "diverged", "at step 5: 9000 K is above the allowed 800 K"),
            walk(3, "diverged", "at step 7: 9999 K is above the allowed 800 K"),
            walk(4, "trapped", "rejected by the shortest-bond guard again and again"),
            walk(5, "quota_reached", ""),
        ];
        let ends = WalkEnds::from_walks(&walks);
        assert_eq!(all(&ends), "2 quota reached, 2 diverged (too hot), 1 trapped");
        assert_eq!(without_causes(&ends), "2 quota reached, 2 diverged, 1 trapped");
        assert!(warning(&ends).starts_with("3 of 5 finished walks ended early (2 too hot, 1 atoms"));
    }
}
