//! Structures drawn at random.

use crate::build::shuffled;

/// `count` of the structures, or all if there are fewer, in random order: a function of the random seed and of `part`, the number
/// of the draw.
pub fn random_structures(structures: &[usize], count: usize, seed: u64, part: u64) -> Vec<usize> {
    shuffled(seed, part, structures.len()).into_iter().take(count).map(|place| structures[place]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_draw_has_no_structure_twice_and_every_structure_equally_often() {
        let structures: Vec<usize> = (0..20).map(|k| 3 * k).collect();
        let mut drawn = [0_u32; 20];
        for part in 0..2000 {
            let mut found = random_structures(&structures, 5, 7, part);
            assert_eq!(found, random_structures(&structures, 5, 7, part));
            found.iter().for_each(|structure| drawn[structure / 3] += 1);
            found.sort_unstable();
            found.dedup();
            assert_eq!(found.len(), 5);
        }
        // A binomial number with mean 500 and standard deviation √375.
        assert!(
            drawn.iter().all(|&times| (f64::from(times) - 500.0).abs() < 5.0 * 375_f64.sqrt()),
            "{drawn:?}"
        );
        assert_eq!(random_structures(&structures, 50, 7, 0).len(), 20);
    }
}
