//! The walks of a campaign. What is asked for every decision is found without looking at every walk.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Index;

use wire::WalkId;

use super::walk::Walk;

/// All walks. Walks are never removed.
#[derive(Default)]
pub(super) struct WalkTable {
    walks: BTreeMap<WalkId, Walk>,
    unfinished_biased: BTreeSet<WalkId>,
    unfinished_controls: BTreeSet<WalkId>,
    /// Biased walks from each seed structure.
    of_seed_structure: BTreeMap<u32, Vec<WalkId>>,
    /// Biased walks that have ended with structures that no control walk has yet.
    without_control: BTreeSet<WalkId>,
    /// Number of assignments that were reported on.
    reported: u64,
}

impl WalkTable {
    /// Adds a walk.
    pub fn insert(&mut self, walk: Walk) {
        let id = walk.record.walk;
        if walk.is_biased() {
            self.of_seed_structure.entry(walk.record.seed_structure).or_default().push(id);
        }
        if !walk.has_ended() {
            self.unfinished_mut(walk.is_biased()).insert(id);
        } else if walk.needs_control() {
            self.without_control.insert(id);
        }
        self.reported += walk.record.assignments;
        self.walks.insert(id, walk);
    }

    pub fn get(&self, id: WalkId) -> Option<&Walk> {
        self.walks.get(&id)
    }

    /// A walk that exists, for changes of anything but its end and the number of its reports.
    pub fn get_mut(&mut self, id: WalkId) -> &mut Walk {
        self.walks.get_mut(&id).expect("walks stay in the table")
    }

    /// Counts a report on the walk's assignment.
    pub fn count_report(&mut self, id: WalkId) -> &mut Walk {
        self.reported += 1;
        let walk = self.get_mut(id);
        walk.record.assignments += 1;
        walk
    }

    /// Ends a walk with this final state, and the reason as text.
    pub fn end(&mut self, id: WalkId, state: &str, reason: String) -> &Walk {
        let walk = self.get_mut(id);
        (walk.record.state, walk.record.reason) = (state.to_owned(), reason);
        let (biased, needs_control) = (walk.is_biased(), walk.needs_control());
        self.unfinished_mut(biased).remove(&id);
        if needs_control {
            self.without_control.insert(id);
        }
        &self[id]
    }

    /// Lets a walk that has ended continue.
    pub fn resume(&mut self, id: WalkId) {
        let walk = self.get_mut(id);
        walk.record.state = "waiting".to_owned();
        let biased = walk.is_biased();
        self.without_control.remove(&id);
        self.unfinished_mut(biased).insert(id);
    }

    /// Adds the control walk of a biased walk.
    pub fn insert_control(&mut self, id: WalkId, of: WalkId, steps_per_assignment: u64) -> &Walk {
        let control = self.get_mut(of).new_control(id, steps_per_assignment);
        self.without_control.remove(&of);
        self.insert(control);
        &self[id]
    }

    pub fn len(&self) -> usize {
        self.walks.len()
    }

    /// Number of assignments of all walks that were reported on.
    pub fn reported(&self) -> u64 {
        self.reported
    }

    /// All walks, in order.
    pub fn iter(&self) -> impl Iterator<Item = &Walk> {
        self.walks.values()
    }

    /// The biased walks, or the control walks, that have not ended, in order.
    pub fn unfinished(&self, biased: bool) -> impl Iterator<Item = WalkId> {
        let walks = if biased { &self.unfinished_biased } else { &self.unfinished_controls };
        walks.iter().copied()
    }

    /// The biased walks from a seed structure that have not ended, in order.
    pub fn unfinished_of_seed_structure(&self, seed_structure: u32) -> impl Iterator<Item = WalkId> {
        let walks = self.of_seed_structure.get(&seed_structure).into_iter().flatten().copied();
        walks.filter(|id| self.unfinished_biased.contains(id))
    }

    /// Whether every walk has ended.
    pub fn have_all_ended(&self) -> bool {
        self.unfinished_biased.is_empty() && self.unfinished_controls.is_empty()
    }

    /// The biased walks that have ended with structures that no control walk has yet, in order.
    pub fn without_control(&self) -> Vec<WalkId> {
        self.without_control.iter().copied().collect()
    }

    fn unfinished_mut(&mut self, biased: bool) -> &mut BTreeSet<WalkId> {
        if biased { &mut self.unfinished_biased } else { &mut self.unfinished_controls }
    }
}

impl Index<WalkId> for WalkTable {
    type Output = Walk;

    fn index(&self, id: WalkId) -> &Walk {
        &self.walks[&id]
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// What happens to one of the walks, which the number selects.
    #[derive(Clone, Debug)]
    enum Step {
        Start { seed: u32 },
        Accept(usize),
        End(usize),
        Resume(usize),
        Control(usize),
        Reload,
    }

    fn steps() -> impl Strategy<Value = Vec<Step>> {
        let step = prop_oneof![
            (0..3_u32).prop_map(|seed| Step::Start { seed }),
            any::<usize>().prop_map(Step::Accept),
            any::<usize>().prop_map(Step::End),
            any::<usize>().prop_map(Step::Resume),
            any::<usize>().prop_map(Step::Control),
            Just(Step::Reload),
        ];
        prop::collection::vec(step, 0..60)
    }

    fn apply(table: &mut WalkTable, step: Step) {
        let new = WalkId(table.len() as u32);
        let one = |table: &WalkTable, number: usize, test: fn(&Walk) -> bool| {
            let some: Vec<_> = table.iter().filter(|walk| test(walk)).map(|walk| walk.record.walk).collect();
            (!some.is_empty()).then(|| some[number % some.len()])
        };
        match step {
            Step::Start { seed } => table.insert(Walk::new(new, seed, Default::default(), 10)),
            Step::Accept(number) => {
                if let Some(id) = one(table, number, |walk| !walk.has_ended() && walk.is_biased()) {
                    let walk = table.count_report(id);
                    walk.state.accepted_steps.push(walk.record.assignments);
                }
            }
            Step::End(number) => {
                if let Some(id) = one(table, number, |walk| !walk.has_ended()) {
                    table.end(id, "quota_reached", String::new());
                }
            }
            Step::Resume(number) => {
                if let Some(id) = one(table, number, Walk::ended_by_budget) {
                    table.resume(id);
                }
            }
            Step::Control(number) => {
                if let Some(id) = one(table, number, Walk::needs_control) {
                    table.insert_control(new, id, 10);
                }
            }
            Step::Reload => {
                let records: Vec<_> = table.iter().map(Walk::to_record).collect();
                *table = WalkTable::default();
                records.into_iter().for_each(|record| table.insert(Walk::restore(record).unwrap()));
            }
        }
    }

    proptest! {
        #[test]
        fn what_is_found_is_what_a_look_at_every_walk_finds(steps in steps()) {
            let mut table = WalkTable::default();
            for step in steps {
                apply(&mut table, step);
                let every = |test: &dyn Fn(&Walk) -> bool| -> Vec<WalkId> {
                    table.iter().filter(|walk| test(walk)).map(|walk| walk.record.walk).collect()
                };
                for biased in [true, false] {
                    let unfinished = every(&|walk| !walk.has_ended() && walk.is_biased() == biased);
                    prop_assert_eq!(table.unfinished(biased).collect::<Vec<_>>(), unfinished);
                }
                for seed in 0..3 {
                    let expected =
                        every(&|walk| !walk.has_ended() && walk.is_biased() && walk.record.seed_structure == seed);
                    prop_assert_eq!(table.unfinished_of_seed_structure(seed).collect::<Vec<_>>(), expected);
                }
                prop_assert_eq!(table.without_control(), every(&Walk::needs_control));
                prop_assert_eq!(table.have_all_ended(), table.iter().all(Walk::has_ended));
                prop_assert_eq!(table.reported(), table.iter().map(|walk| walk.record.assignments).sum::<u64>());
            }
        }
    }
}
