//! Guards that keep a walk physical: which structures are rejected as candidates, and when a walk ends.

use atoms::{Evaluation, Neighbour, NeighbourList, Structure, cell};

use crate::settings::GuardSettings;

/// Name of the guard against atoms that are too close.
pub const SHORTEST_BOND: &str = "shortest-bond";
/// Name of the guard against grades that no label is wanted for.
pub const LARGEST_GRADE: &str = "largest-grade";

/// The reason to end a walk, if there is one: forces that are not finite, a temperature (K) above the limit, or an
/// atom without neighbours within the cutoff.
pub fn blown_up(
    settings: &GuardSettings,
    structure: &Structure,
    neighbours: &NeighbourList,
    evaluation: &Evaluation,
    temperature: f64,
) -> Option<String> {
    if let Some(atom) = evaluation.forces.iter().position(|f| f.iter().any(|x| !x.is_finite())) {
        return Some(format!("the force on atom {atom} is not finite"));
    }
    if temperature.is_nan() || temperature > settings.max_temperature {
        let highest = settings.max_temperature;
        return Some(format!("{temperature:.0} K is above the allowed {highest:.0} K"));
    }
    if structure.len() > 1 {
        // The list also holds pairs within its skin, which depend on when it was built.
        let lost = (0..structure.len()).find(|i| {
            let distance = |neighbour: &Neighbour| cell::norm(neighbour.displacement(structure, *i));
            !neighbours.neighbours_of(*i).iter().any(|neighbour| distance(neighbour) < neighbours.cutoff())
        });
        return lost.map(|atom| format!("atom {atom} has no neighbour within {:.2} Å", neighbours.cutoff()));
    }
    None
}
