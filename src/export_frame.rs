//! A labelled structure as a frame with its origin, and its quantities for filters.

use std::collections::BTreeMap;

use atoms::extxyz::{Column, ColumnData, ExtxyzValue, Frame, FrameLabels, LabelKeys};
use atoms::fragments;
use dft::RetryAdjustment;
use store::records::Label;
use store::{ExportRow, ExportSource};
use wire::{WalkConditions, WalkId};

use crate::filter::StructureProperties;

/// Version of the potential that drove the walk of a frame; only in campaigns with several versions.
const VERSION: &str = "calmwalk_version";

/// The retry adjustments without those of memory, time and nodes: they depend on the machine and change no label, and an export has
/// the same bytes whatever was killed.
fn of_calculation(names: &[String]) -> Vec<&str> {
    let of_resources =
        |name: &str| RetryAdjustment::ALL.iter().any(|known| known.is_of_resources() && known.name() == name);
    names.iter().map(String::as_str).filter(|name| !of_resources(name)).collect()
}

/// The quantities of a structure for a filter.
pub fn facts<'a>(
    row: &'a ExportRow,
    conditions: &'a BTreeMap<WalkId, WalkConditions>,
) -> StructureProperties<'a> {
    let largest = |grades: &[f64]| grades.iter().copied().reduce(f64::max);
    let of_label = StructureProperties {
        energy: Some(row.label.energy),
        max_force: Some(row.label.max_force()),
        retry_adjustments: Some(&row.label.details.retry_adjustments),
        fragments: fragments(&row.structure).ok(),
        species: &row.structure.species,
        origin: "imported",
        ..StructureProperties::default()
    };
    let ExportSource::Candidate {
        block,
        selector_gamma,
        original,
        origin,
        seed_structure_name,
        mixture_version_after,
        ..
    } = &row.source
    else {
        return of_label;
    };
    let view = block.view();
    StructureProperties {
        gamma: largest(&original.gamma),
        gamma_current: *selector_gamma,
        gamma_nbr: largest(&original.gamma_nbr),
        relative_volume: Some(view.relative_volume()),
        kinetic_temperature: Some(view.temperature()),
        conditions: conditions.get(&view.id().walk),
        walk: Some(view.id().walk.0),
        step: Some(view.id().step),
        mixture_version: Some(*mixture_version_after),
        origin: origin.name(),
        seed_structure: Some(seed_structure_name),
        ..of_label
    }
}

/// The frame of a labelled structure, with the conditions of its walk if they are known.
pub fn frame(
    row: ExportRow,
    keys: LabelKeys,
    campaign: &str,
    conditions: &BTreeMap<WalkId, WalkConditions>,
) -> Frame {
    let fragments = fragments(&row.structure).ok();
    let mut frame = Frame::from(row.structure);
    add_label(&mut frame, row.label, keys);
    if let Some(fragments) = fragments {
        frame.info.insert("fragments".to_owned(), integer(fragments as u64));
    }
    let mut info = |key: &str, value: ExtxyzValue| frame.info.insert(key.to_owned(), value);
    info("campaign", campaign.into());
    info("protocol", row.protocol_name.into());
    info("protocol_hash", row.protocol.to_string().chars().take(16).collect::<String>().into());
    add_source(&mut frame, row.source, conditions);
    frame
}

fn add_label(frame: &mut Frame, label: Label, keys: LabelKeys) {
    let labels = FrameLabels { energy: Some(label.energy), forces: Some(label.forces), stress: label.stress };
    frame.set_labels(&labels, keys);
    let details = label.details;
    if let Some(moments) = details.magnetic_moments {
        frame.arrays.insert("magmoms".to_owned(), scalars(moments));
    }
    let mut info = |key: &str, value: ExtxyzValue| frame.info.insert(key.to_owned(), value);
    for (key, number) in
        [("energy_without_smearing", details.energy_without_smearing), ("magmom", details.magnetisation)]
    {
        if let Some(number) = number {
            info(key, number.into());
        }
    }
    let adjustments = of_calculation(&details.retry_adjustments);
    if !adjustments.is_empty() {
        info("retry_adjustments", adjustments.join(",").into());
    }
}

/// Adds what is known of the origin of a structure.
fn add_source(frame: &mut Frame, source: ExportSource, conditions: &BTreeMap<WalkId, WalkConditions>) {
    // Walks with later versions have higher numbers.
    let has_versions = conditions.values().next_back().is_some_and(|last| last.version > 0);
    let mut info = |key: &str, value: ExtxyzValue| frame.info.insert(key.to_owned(), value);
    match source {
        ExportSource::Candidate {
            id,
            seed_structure_name,
            origin,
            mixture_version_after,
            block,
            selector_gamma,
            original,
            ..
        } => {
            let view = block.view();
            info("candidate_id", id.into());
            info("seed_structure", seed_structure_name.into());
            info("walk", i64::from(view.id().walk.0).into());
            info("segment", i64::from(view.id().segment).into());
            info("step", integer(view.id().step));
            info("origin", origin.name().into());
            if let Some(conditions) = conditions.get(&view.id().walk) {
                if !conditions.group.is_empty() {
                    info("group", conditions.group.clone().into());
                }
                info("temperature", conditions.temperature.into());
                info("tau", conditions.tau.into());
            }
            if has_versions {
                let version = conditions.get(&view.id().walk).map_or(0, |conditions| conditions.version);
                info(VERSION, i64::from(version).into());
            }
            info("mixture_version", integer(mixture_version_after));
            info("mixture_version_seen", integer(view.mixture_version()));
            info("relative_volume", view.relative_volume().into());
            let largest = original.gamma.iter().copied().reduce(f64::max);
            for (key, gamma) in [("gamma_max", selector_gamma), ("gamma_max_original", largest)] {
                if let Some(gamma) = gamma {
                    info(key, gamma.into());
                }
            }
            frame.arrays.insert("gamma".to_owned(), scalars(original.gamma));
            frame.arrays.insert("gamma_nbr".to_owned(), scalars(original.gamma_nbr));
        }
        ExportSource::Import { file, frame } => {
            info("origin", "imported".into());
            info("source_file", file.into());
            info("source_frame", integer(frame));
        }
    }
}

/// A number for each atom.
fn scalars(values: Vec<f64>) -> Column {
    Column { width: 1, entries: ColumnData::Real(values) }
}

fn integer(number: u64) -> ExtxyzValue {
    ExtxyzValue::Int(i64::try_from(number).unwrap_or(i64::MAX))
}

#[cfg(test)]
mod tests {
    use atoms::{Cell, Structure};
    use wire::{CampaignId, Candidate, CandidateBlock, CandidateId, ContentHash, Origin};

    use super::*;

    /// A candidate of walk 1.
    fn candidate() -> ExportSource {
        let structure = Structure {
            species: vec!["Al".parse().unwrap()],
            positions: vec![[0.0; 3]],
            cell: Cell::orthorhombic(4.0, 4.0, 4.0),
            periodic: [true; 3],
        };
        let content = ContentHash::from_structure(&structure);
        let block = CandidateBlock::encode(&Candidate {
            id: CandidateId { campaign: CampaignId([7; 16]), walk: WalkId(1), segment: 0, step: 5, content },
            origin: Origin::Biased,
            mixture_version: 0,
            temperature: 300.0,
            relative_volume: 1.0,
            energy: -1.0,
            virial: [[0.0; 3]; 3],
            structure,
            forces: vec![[0.0; 3]],
            gamma: vec![1.5],
            gamma_nbr: vec![1.5],
            features: Vec::new(),
        });
        ExportSource::Candidate {
            id: "07070707-1.0.5-0123456789abcdef".into(),
            seed_structure: 0,
            seed_structure_name: "fcc".into(),
            origin: Origin::Biased,
            mixture_version_after: 1,
            block,
            selector_gamma: Some(1.5),
            original: Default::default(),
        }
    }

    #[test]
    fn frames_have_their_version_if_there_are_several() {
        let version_in = |versions: [u32; 3]| {
            let walk =
                |(walk, version)| (WalkId(walk), WalkConditions { version, ..WalkConditions::default() });
            let conditions: BTreeMap<_, _> = (0..).zip(versions).map(walk).collect();
            let structure = match candidate() {
                ExportSource::Candidate { block, .. } => block.view().structure(),
                ExportSource::Import { .. } => unreachable!("it is a candidate"),
            };
            let mut frame = Frame::from(structure);
            add_source(&mut frame, candidate(), &conditions);
            frame.info.get(VERSION).cloned()
        };
        assert_eq!(version_in([0, 0, 0]), None);
        assert_eq!(version_in([0, 0, 1]), Some(0_i64.into()));
        assert_eq!(version_in([0, 2, 2]), Some(2_i64.into()));
    }

    #[test]
    fn adjustments_of_resources_are_left_out() {
        let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
        let all: Vec<String> = RetryAdjustment::ALL.iter().map(|one| one.name().to_owned()).collect();
        let kept = ["more_steps", "slower_mixing", "other_algorithm", "other_moments"];
        assert_eq!(of_calculation(&all), kept);
        assert!(of_calculation(&names(&["other_node"])).is_empty());
        assert_eq!(of_calculation(&names(&["of_a_later_version"])), ["of_a_later_version"]);
    }
}
