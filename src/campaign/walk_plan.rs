//! The walks of a campaign: from each seed structure one under every combination of conditions that the groups name.

use atoms::Structure;
use wire::WalkConditions;

use super::load::{Loader, SourcedStructure};
use crate::config::{ConfigError, VolumeRampSection, WalkGroupSection, WalkSection, Warning, place};
use crate::filter::{Filter, StructureProperties};

/// Largest number of biased walks.
const MAX_WALKS: usize = 1_000_000;

/// Properties of seed structures that a filter may name.
const PROPERTIES: [&str; 3] = ["atoms", "element", "seed_structure"];

impl Loader<'_> {
    /// Sets the walks of each seed structure. Warns of seed structures without walks.
    pub fn plan_walks(&self, seeds: &mut [SourcedStructure]) -> Result<Vec<Warning>, ConfigError> {
        let groups = &self.config.walks;
        if groups.is_empty() {
            let conditions = combinations(&self.config.walk, &WalkGroupSection::default());
            seeds.iter_mut().for_each(|named| named.seed.walks.clone_from(&conditions));
            return Ok(Vec::new());
        }
        for (number, group) in groups.iter().enumerate() {
            self.add_group(number, group, seeds)?;
        }
        let walks: usize = seeds.iter().map(|named| named.seed.walks.len()).sum();
        if walks > MAX_WALKS {
            return Err(self.walks_error("walks", format!("{walks} walks; expected at most {MAX_WALKS}")));
        }
        let without = seeds.iter().filter(|named| named.seed.walks.is_empty());
        let warning = |named: &SourcedStructure| Warning {
            at: place(self.path, self.text, "walks"),
            key: "walks".to_owned(),
            message: format!(
                "seed structure '{}' ({}) is in no group: no walk starts from it",
                named.seed.name, named.source
            ),
        };
        Ok(without.map(warning).collect())
    }

    /// Adds the walks of one group to the seed structures that it selects.
    fn add_group(
        &self,
        number: usize,
        group: &WalkGroupSection,
        seeds: &mut [SourcedStructure],
    ) -> Result<(), ConfigError> {
        let filter = match &group.seed_structures {
            Some(text) => Some(self.seed_filter(number, text)?),
            None => None,
        };
        let conditions = combinations(&self.config.walk, group);
        let mut selected = 0;
        for named in seeds {
            let (name, structure) = (&named.seed.name, &named.seed.structure);
            if filter.as_ref().is_some_and(|filter| !is_selected(filter, name, structure)) {
                continue;
            }
            if structure.periodic == [false; 3] && conditions.iter().any(WalkConditions::changes_volume) {
                let message = format!(
                    "group '{}' changes the volume, but seed structure '{name}' ({}) has no periodic direction; leave it out \
                     (seed_structures = \"seed_structure != '{name}'\"), or give the group volume_ramps = [{{ from = 1.0, to = 1.0 }}]",
                    group.name, named.source
                );
                return Err(self.walks_error(&format!("walks.{number}"), message));
            }
            named.seed.walks.extend(conditions.iter().cloned());
            selected += 1;
        }
        match (&group.seed_structures, selected) {
            (Some(text), 0) => {
                let message = format!("no seed structure is selected by '{text}'; expected at least one");
                Err(self.walks_error(&format!("walks.{number}.seed_structures"), message))
            }
            _ => Ok(()),
        }
    }

    fn seed_filter(&self, number: usize, text: &str) -> Result<Filter, ConfigError> {
        let key = format!("walks.{number}.seed_structures");
        let filter: Filter =
            text.parse().map_err(|error| self.walks_error(&key, format!("'{text}': {error}")))?;
        match filter.names().into_iter().find(|name| !PROPERTIES.contains(name)) {
            Some(name) => {
                let expected = PROPERTIES.join(", ");
                Err(self.walks_error(&key, format!("'{text}': found '{name}', expected one of {expected}")))
            }
            None => Ok(filter),
        }
    }

    fn walks_error(&self, key: &str, message: String) -> ConfigError {
        ConfigError::File { at: place(self.path, self.text, key), key: key.to_owned(), message }
    }
}

fn is_selected(filter: &Filter, name: &str, structure: &Structure) -> bool {
    let properties = StructureProperties {
        species: &structure.species,
        seed_structure: Some(name),
        ..StructureProperties::default()
    };
    filter.matches(&properties)
}

/// All combinations of a group's conditions: by temperature, then by volume ramp, then by τ, then the repeats.
fn combinations(walk: &WalkSection, group: &WalkGroupSection) -> Vec<WalkConditions> {
    let or = |values: &[_], default| if values.is_empty() { vec![default] } else { values.to_vec() };
    let ramps = match group.volume_ramps.as_slice() {
        [] => vec![walk.volume_ramp],
        ramps => ramps.iter().copied().map(Some).collect(),
    };
    let mut walks = Vec::new();
    for temperature in or(&group.temperatures, walk.temperature) {
        for ramp in &ramps {
            for tau in or(&group.tau_values, walk.tau) {
                let conditions = |repeat| WalkConditions {
                    group: group.name.clone(),
                    temperature: temperature.get(),
                    tau: tau.get(),
                    volume_ramp: ramp.map(|VolumeRampSection { from, to }| (from.get(), to.get())),
                    repeat,
                };
                walks.extend((0..group.repeats.get()).map(conditions));
            }
        }
    }
    walks
}

#[cfg(test)]
mod tests {
    use super::*;

    fn walk(text: &str) -> WalkSection {
        toml::from_str(text).unwrap()
    }

    #[test]
    fn a_group_walks_under_every_combination() {
        let walk =
            walk("temperature = 500\nbiased_steps = 10\ntau = 0.2\nvolume_ramp = { from = 1.0, to = 1.4 }");
        let described = |group: &str| {
            let group: WalkGroupSection = toml::from_str(group).unwrap();
            let all = combinations(&walk, &group);
            let describe = |w: &WalkConditions| {
                let (from, to) = w.volume_ramp.unwrap();
                format!("{} {from}-{to} {} {}", w.temperature, w.tau, w.repeat)
            };
            all.iter().map(describe).collect::<Vec<_>>()
        };
        assert_eq!(described("name = 'as it is'"), ["500 1-1.4 0.2 0"]);
        let group = "name = 'a'\ntemperatures = [300, 900]\nrepeats = 2\nvolume_ramps = [{ from = 1.0, to = 0.8 }, { from = 0.9, \
                     to = 1.1 }]\ntau_values = [0.1, 0.3]";
        let all = described(group);
        assert_eq!(all.len(), 16);
        assert_eq!(
            all[..5],
            ["300 1-0.8 0.1 0", "300 1-0.8 0.1 1", "300 1-0.8 0.3 0", "300 1-0.8 0.3 1", "300 0.9-1.1 0.1 0"]
        );
        assert_eq!(all[8], "900 1-0.8 0.1 0");
    }
}
