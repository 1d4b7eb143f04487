//! Enough atoms of each element in what was picked.

/// What [`meet`] did.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Exchanges {
    /// Structures that were picked and are not any more.
    pub removed: Vec<usize>,
    /// Structures that are picked in their place, in this order.
    pub added: Vec<usize>,
    /// Elements that still have fewer atoms than the floor and the pool allow.
    pub short: Vec<usize>,
}

/// Exchanges picked structures until each element has `floor` atoms in what is picked, or all that the pool has of it.
///
/// `atoms(s, e)` is the number of atoms of element e in structure s of `structures`; `picked` has those that are picked, each with
/// whether it may be exchanged. For one element after the other, the structure of the pool with the most atoms of it (the first of
/// several) takes the place of the last picked one that may be exchanged and without which every other element keeps its floor.
pub fn meet(
    structures: usize,
    elements: usize,
    atoms: impl Fn(usize, usize) -> u64,
    picked: &[(usize, bool)],
    floor: u64,
) -> Exchanges {
    let total = |element| (0..structures).map(|structure| atoms(structure, element)).sum::<u64>();
    let floors: Vec<u64> = (0..elements).map(|element| floor.min(total(element))).collect();
    let count = |structure: usize, sign: i64, have: &mut [i64]| {
        have.iter_mut()
            .enumerate()
            .for_each(|(element, have)| *have += sign * atoms(structure, element) as i64);
    };
    let (mut have, mut is_picked) = (vec![0; elements], vec![false; structures]);
    for (structure, _) in picked {
        count(*structure, 1, &mut have);
        is_picked[*structure] = true;
    }
    let mut exchangeable: Vec<usize> = picked.iter().filter(|(_, may)| *may).map(|(s, _)| *s).collect();
    let mut exchanges = Exchanges::default();
    for element in 0..elements {
        while have[element] < floors[element] as i64 {
            let others = (0..structures).filter(|structure| !is_picked[*structure]);
            let richest = others.max_by_key(|&s| (atoms(s, element), std::cmp::Reverse(s)));
            let keeps = |&s: &usize, gained: u64| {
                let after =
                    |e: usize| have[e] - atoms(s, e) as i64 + if e == element { gained as i64 } else { 0 };
                (0..elements).all(|e| after(e) >= (floors[e] as i64).min(have[e]))
                    && after(element) > have[element]
            };
            let gained = richest.map_or(0, |s| atoms(s, element));
            let place = exchangeable.iter().rposition(|s| keeps(s, gained));
            let (Some(added), Some(place)) = (richest, place) else {
                exchanges.short.push(element);
                break;
            };
            let removed = exchangeable.remove(place);
            count(removed, -1, &mut have);
            count(added, 1, &mut have);
            (is_picked[removed], is_picked[added]) = (false, true);
            exchanges.removed.push(removed);
            exchanges.added.push(added);
        }
    }
    exchanges
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_richest_structure_takes_the_place_of_the_last_that_can_be_spared() {
        let atoms = [[4, 0], [4, 0], [2, 2], [0, 3], [0, 5]];
        let of = |s: usize, e: usize| atoms[s][e];
        let picked = [(0, true), (1, true), (2, true)];
        let found = meet(5, 2, of, &picked, 5);
        // Of the second element 2 atoms are picked, and structure 4 has 5.
        assert_eq!(found, Exchanges { removed: vec![2], added: vec![4], short: vec![] });
        assert_eq!(meet(5, 2, of, &picked, 2), Exchanges::default());
        let fixed = [(0, false), (1, false)];
        assert_eq!(meet(5, 2, of, &fixed, 5), Exchanges { short: vec![1], ..Exchanges::default() });
    }

    proptest! {
        #[test]
        fn floors_are_met_and_the_number_of_structures_is_kept(
            atoms in prop::collection::vec(prop::array::uniform3(0_u64..6), 1..30),
            number in 0_usize..30,
            floor in 0_u64..20,
        ) {
            let picked: Vec<_> = (0..atoms.len().min(number)).map(|s| (s, s % 4 != 0)).collect();
            let found = meet(atoms.len(), 3, |s, e| atoms[s][e], &picked, floor);
            let mut after: Vec<usize> = picked.iter().map(|(s, _)| *s).collect();
            for (removed, added) in found.removed.iter().zip(&found.added) {
                let place = after.iter().position(|s| s == removed).unwrap();
                prop_assert!(!after.contains(added) && removed % 4 != 0);
                after[place] = *added;
            }
            let sum = |of: &[usize], e: usize| of.iter().map(|s| atoms[*s][e]).sum::<u64>();
            let before: Vec<usize> = picked.iter().map(|(s, _)| *s).collect();
            let all: Vec<usize> = (0..atoms.len()).collect();
            for e in 0..3 {
                let needed = floor.min(sum(&all, e));
                prop_assert!(sum(&after, e) >= needed.min(sum(&before, e)));
                prop_assert!(sum(&after, e) >= needed || found.short.contains(&e));
            }
        }
    }
}
