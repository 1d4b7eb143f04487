//! The walks of a campaign: from each seed structure one under every combination of conditions that the groups name.

use std::collections::BTreeMap;

use atoms::Structure;
use calm::rules::Positive;
use md::BarostatSettings;
use orchestrator::selector::SeedStructurePlan;
use wire::{CellConditions, ConstantPressure, WalkConditions};

use super::geometry::cell_bias_fault;
use super::loader::Loader;
use super::seed_structures::{SeedStructures, SourcedStructure, listed};
use crate::config::{
    ConfigError, OnInvalid, VolumeRampSection, WalkGroupSection, WalkSection, Warning, location,
};
use crate::filter::{StructureFilter, StructureProperties};

/// Largest number of biased walks.
const MAX_WALKS: usize = 1_000_000;

/// What else can be done about a structure without a volume.
const CONSTANT_VOLUME: &str = ", or give the group volume_ramps = [{ from = 1.0, to = 1.0 }]";

/// Properties of seed structures that a filter may name.
const PROPERTIES: [&str; 3] = ["atoms", "element", "seed_structure"];

impl Loader<'_> {
    /// Sets the walks of each seed structure. A structure without a volume gets no walk that would change it: without
    /// any other walk it is skipped. Warns of this, of groups without walks, and of structures in no group.
    pub fn plan_walks(&self, seeds: &mut SeedStructures) -> Result<Vec<Warning>, ConfigError> {
        let groups = &self.config.walks;
        if groups.is_empty() {
            let conditions = combinations(&self.config.walk, &WalkGroupSection::default());
            seeds.valid.iter_mut().for_each(|named| named.plan.walks.clone_from(&conditions));
            return Ok(Vec::new());
        }
        let (mut without_volume, mut messages) = (BTreeMap::new(), Vec::new());
        for (number, group) in groups.iter().enumerate() {
            messages.extend(self.add_group(number, group, seeds, &mut without_volume)?);
        }
        match seeds.valid.iter().map(|named| named.plan.walks.len()).sum::<usize>() {
            1..=MAX_WALKS => {}
            0 => {
                let reason = without_volume.values().chain(&messages).next().map_or("", String::as_str);
                return Err(self.walks_error("walks", format!("no walk can start: {reason}")));
            }
            walks => {
                let message = format!("{walks} walks; expected at most {MAX_WALKS}");
                return Err(self.walks_error("walks", message));
            }
        }
        seeds.skip(|SourcedStructure { plan, .. }| {
            without_volume.get(&plan.name).filter(|_| plan.walks.is_empty()).cloned()
        });
        let (mut fewer, mut no_group) = (Vec::new(), Vec::new());
        for SourcedStructure { plan: SeedStructurePlan { name, walks, .. }, source, .. } in &seeds.valid {
            if let Some(reason) = without_volume.get(name) {
                let message =
                    format!("seed structure '{name}' ({source}) walks at its own volume only: {reason}");
                fewer.push(message);
            }
            if walks.is_empty() {
                let message =
                    format!("seed structure '{name}' ({source}) is in no group: no walk starts from it");
                no_group.push(message);
            }
        }
        messages.extend(listed(fewer, "walk at their own volume only"));
        messages.extend(listed(no_group, "are in no group"));
        let (at, key) = (location(self.path, self.text, "walks"), "walks".to_owned());
        let warning = |message| Warning { at: at.clone(), key: key.clone(), message };
        Ok(messages.into_iter().map(warning).collect())
    }

    /// Adds the walks of one group to the seed structures that it selects. `without_volume` has the reason for each
    /// structure that does not get all of them, by name. Returns a warning if the group has no walks.
    fn add_group(
        &self,
        number: usize,
        group: &WalkGroupSection,
        seeds: &mut SeedStructures,
        without_volume: &mut BTreeMap<String, String>,
    ) -> Result<Option<String>, ConfigError> {
        let filter = match &group.seed_structures {
            Some(text) => Some(self.seed_structure_filter(number, text)?),
            None => None,
        };
        let selects = |SeedStructurePlan { name, structure, .. }: &SeedStructurePlan| {
            filter.as_ref().is_none_or(|filter| is_selected(filter, name, structure))
        };
        let conditions = combinations(&self.config.walk, group);
        let (mut selected, mut walks) = (seeds.skipped.iter().any(|skipped| selects(&skipped.plan)), 0);
        for SourcedStructure { plan, source, .. } in &mut seeds.valid {
            if !selects(plan) {
                continue;
            }
            selected = true;
            let (name, structure) = (&plan.name, &plan.structure);
            let fault = |conditions: &WalkConditions| cell_fault(&self.config.walk, conditions, structure);
            if let Some(fault) = conditions.iter().find_map(fault) {
                let reason = format!(
                    "group '{}' {fault}; leave it out (seed_structures = \"seed_structure != '{name}'\"){}",
                    group.name,
                    if group.pressures.is_empty() { CONSTANT_VOLUME } else { "" }
                );
                if self.config.seed_structures.on_invalid == OnInvalid::Error {
                    let message = format!("seed structure '{name}' ({source}): {reason}");
                    return Err(self.walks_error(&format!("walks.{number}"), message));
                }
                without_volume.entry(name.clone()).or_insert(reason);
            }
            let before = plan.walks.len();
            plan.walks.extend(conditions.iter().filter(|conditions| fault(conditions).is_none()).cloned());
            walks += plan.walks.len() - before;
        }
        match &group.seed_structures {
            Some(text) if !selected => {
                let message = format!("no seed structure is selected by '{text}'; expected at least one");
                Err(self.walks_error(&format!("walks.{number}.seed_structures"), message))
            }
            _ => Ok((walks == 0).then(|| {
                format!(
                    "group '{}' has no walk: none can start from the seed structures that it selects",
                    group.name
                )
            })),
        }
    }

    fn seed_structure_filter(&self, number: usize, text: &str) -> Result<StructureFilter, ConfigError> {
        let key = format!("walks.{number}.seed_structures");
        let filter: StructureFilter =
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
        ConfigError::File { at: location(self.path, self.text, key), key: key.to_owned(), message }
    }
}

fn is_selected(filter: &StructureFilter, name: &str, structure: &Structure) -> bool {
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
    let cells = cells(walk, group);
    let mut walks = Vec::new();
    for temperature in or(&group.temperatures, walk.temperature) {
        for cell in cells.iter().copied() {
            for tau in or(&group.tau_values, walk.tau) {
                let conditions = |repeat| WalkConditions {
                    group: group.name.clone(),
                    temperature: temperature.get(),
                    tau: tau.get(),
                    cell,
                    repeat,
                    version: 0,
                };
                walks.extend((0..group.repeats.get()).map(conditions));
            }
        }
    }
    walks
}

/// Why the cell of a structure cannot do what these conditions ask, if it cannot.
fn cell_fault(walk: &WalkSection, conditions: &WalkConditions, structure: &Structure) -> Option<String> {
    if structure.periodic == [false; 3] && conditions.changes_volume() {
        return Some("changes the volume, but the structure has no periodic direction".to_owned());
    }
    let constant = conditions.constant_pressure()?;
    let barostat = BarostatSettings { pressure: constant.pressure, ..walk.barostat.unwrap_or_default() };
    if let Some(fault) = barostat.fault(conditions.temperature, &walk.thermostat, structure) {
        return Some(format!("has a barostat: {fault}"));
    }
    let fault = cell_bias_fault(structure).filter(|_| constant.cell_bias)?;
    Some(format!("has a bias on the cell: {fault}"))
}

/// What the cells of a group's walks do: its ramps, or each pressure with each volume at the start.
fn cells(walk: &WalkSection, group: &WalkGroupSection) -> Vec<CellConditions> {
    let ramp =
        |ramp: VolumeRampSection| CellConditions::VolumeRamp { from: ramp.from.get(), to: ramp.to.get() };
    if !group.volume_ramps.is_empty() {
        return group.volume_ramps.iter().copied().map(ramp).collect();
    }
    let pressures = match (group.pressures.as_slice(), &walk.barostat) {
        ([], None) => return vec![walk.volume_ramp.map_or(CellConditions::Fixed, ramp)],
        ([], Some(barostat)) => vec![barostat.pressure],
        (pressures, _) => pressures.to_vec(),
    };
    let volumes = match group.start_volumes.as_slice() {
        [] => vec![walk.start_volume],
        volumes => volumes.to_vec(),
    };
    let cell_bias = group.cell_bias.unwrap_or(walk.cell_bias.is_some());
    let constant = |pressure: f64, start: Positive| {
        CellConditions::ConstantPressure(ConstantPressure { pressure, start_volume: start.get(), cell_bias })
    };
    pressures.iter().flat_map(|pressure| volumes.iter().map(|start| constant(*pressure, *start))).collect()
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
                let (from, to) = w.volume_ramp().unwrap();
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
