//! Guards that keep a walk physical: which structures are refused as candidates, and when a walk ends.

use atoms::{Evaluation, Neighbour, NeighbourList, Structure, cell, shortest_distance};

use crate::settings::GuardSettings;

/// Name of the guard against atoms that are too close.
pub const SHORTEST_BOND: &str = "shortest-bond";

/// max(least, fraction × shortest distance of the seed structure), Å (paper: max(1.2 Å, 0.75 d_nn⁰)).
pub fn min_distance(settings: &GuardSettings, seed_shortest: Option<f64>) -> f64 {
    let relative = seed_shortest.map_or(0.0, |d| settings.min_distance_fraction * d);
    settings.min_distance.max(relative)
}

/// Whether two atoms are closer than `min_atoms` Å.
pub fn too_close(structure: &Structure, neighbours: &NeighbourList, least: f64) -> bool {
    shortest_distance(structure, neighbours).is_some_and(|(_, _, d)| d < least)
}

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
