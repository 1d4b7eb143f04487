//! The walks for a model of one phase: the collection of configs/al-collect.toml.

use atoms::{Species, Structure};

use super::written_section::{WrittenKey, WrittenSection, list};

/// Atoms of a seed structure, as in the paper.
pub const MIN_ATOMS: usize = 108;

/// V/V₀ at which walks start, as in the paper.
const START_VOLUMES: [f64; 4] = [0.94, 0.97, 1.03, 1.06];
/// K, as in the paper.
const TEMPERATURE: f64 = 300.0;
const TAU: f64 = 0.15;
const BIASED_STEPS: u64 = 100_000;
/// Structures of all walks, as in the paper.
const MAX_STRUCTURES: usize = 200;

/// Largest relative difference between the volumes per atom of structures of one phase: strained crystals.
const MAX_VOLUME_DIFFERENCE: f64 = 0.25;

/// Whether these are bulk structures of one composition and about one density.
pub fn is_one_phase(structures: &[&Structure]) -> bool {
    let Some(first) = structures.first() else { return false };
    let volume = |structure: &Structure| structure.cell.volume() / structure.len() as f64;
    let has_composition_of_first = |structure: &&&Structure| {
        let number = |of: &Structure, element: Species| {
            of.species.iter().filter(|species| **species == element).count()
        };
        let is_same = |element: &Species| {
            number(structure, *element) * first.len() == number(first, *element) * structure.len()
        };
        first.species.iter().all(is_same)
    };
    let volumes = || structures.iter().map(|structure| volume(structure));
    let (least, most) = (volumes().fold(f64::INFINITY, f64::min), volumes().fold(0.0, f64::max));
    structures.iter().all(|structure| structure.periodic == [true; 3])
        && structures.iter().filter(has_composition_of_first).count() == structures.len()
        && most <= (1.0 + MAX_VOLUME_DIFFERENCE) * least
}

/// Number of walks from so many seed structures.
pub fn walks(structures: usize) -> usize {
    structures * START_VOLUMES.len()
}

/// What updates of the mixture accumulate.
pub fn update_key() -> WrittenKey {
    let comment = "each walk starts from this mixture, as in the paper; \"cumulative\": what one has found, no other collects";
    WrittenKey::new("update", "\"per_walk\"", comment)
}

/// The sections of dynamics and collection for so many walks.
pub fn walk_sections(walks: usize) -> [WrittenSection; 3] {
    let ranged = |name, key, value: String, comment| {
        WrittenKey::new(name, value, WrittenKey::with_range(comment, key))
    };
    let walk = vec![
        ranged("temperature", "walk.temperature", format!("{TEMPERATURE:?}"), "K"),
        ranged("biased_steps", "walk.biased_steps", BIASED_STEPS.to_string(), "at most"),
        ranged("tau", "walk.tau", format!("{TAU:?}"), "strength of the bias on atoms"),
        WrittenKey::new("thermostat", "{ nose_hoover = { relaxation_time = 100.0 } }", "fs"),
        WrittenKey::new("barostat", "{ pressure = 1.0 }", "bar; the cell is flexible"),
        WrittenKey::new("cell_bias", "{}", "the cell is driven along the grades too (docs/dynamics.md)"),
    ];
    let volumes = list(START_VOLUMES.map(|volume| format!("{volume:?}")));
    let group = vec![
        WrittenKey::new("name", "\"driven\"", "one walk for each structure and volume"),
        WrittenKey::new(
            "start_volumes",
            volumes,
            "V/V₀; V₀ is the mean volume of an unbiased run before the walk",
        ),
    ];
    let limit = |name, value: usize, key: &str, comment: &str| {
        WrittenKey::new(name, value.to_string(), WrittenKey::with_range(comment, key))
    };
    let per_walk = MAX_STRUCTURES.div_ceil(walks.max(1));
    let collect = vec![
        WrittenKey::new(
            "criterion",
            "{ rule = \"maximum_grade\", threshold = 1.5 }",
            "collect when γ_max > 1.5",
        ),
        WrittenKey::new(
            "update_target",
            "{ rule = \"maximum_grade\", target = 1.25 }",
            "update the mixture until γ_max < 1.25",
        ),
        ranged("min_interval", "collect.min_interval", "10".to_owned(), "steps between structures of a walk"),
        limit("max_per_walk", per_walk, "collect.max_per_walk", "structures of one walk, at most"),
        limit("max_structures", MAX_STRUCTURES, "collect.max_structures", "structures in all, at most"),
    ];
    [
        WrittenSection::new("[walk]", walk),
        WrittenSection::new("[[walks]]", group),
        WrittenSection::new("[collect]", collect),
    ]
}

#[cfg(test)]
mod tests {
    use atoms::Cell;

    use super::*;

    fn crystal(symbols: &[&str], length: f64) -> Structure {
        Structure {
            species: symbols.iter().map(|symbol| symbol.parse().unwrap()).collect(),
            positions: vec![[0.0; 3]; symbols.len()],
            cell: Cell([[length, 0.0, 0.0], [0.0, length, 0.0], [0.0, 0.0, length]]),
            periodic: [true; 3],
        }
    }

    #[test]
    fn one_phase_is_bulk_of_one_composition_and_density() {
        let (one, two) = (crystal(&["Al", "Ni"], 4.0), crystal(&["Ni", "Al", "Al", "Ni"], 5.1));
        assert!(is_one_phase(&[&one]) && is_one_phase(&[&one, &two]) && !is_one_phase(&[]));
        let slab = Structure { periodic: [true, true, false], ..one.clone() };
        for other in [slab, crystal(&["Al", "Al"], 4.0), crystal(&["Al", "Ni"], 4.4)] {
            assert!(!is_one_phase(&[&one, &other]), "{other:?}");
        }
    }
}
