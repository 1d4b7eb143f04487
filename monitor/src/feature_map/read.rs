//! Reads a bounded sample of the collected structures with their features.

use std::collections::BTreeMap;
use std::sync::Arc;

use analysis::SystematicSample;
use atoms::Species;
use atoms::cell::{norm, sub};
use store::{CollectedFeatures, Store, StoreError};
use wire::Origin;

use super::plane::{FeaturePoint, NumberedComponent, plane};
use super::{FeatureSpaceMap, MAX_ELEMENTS, MapPlane, MapPoint, MappedStructure, ShownPart};
use crate::mixture_status::InitialMixture;

/// Numbers of accepted candidates, and of frames of control walks, that are read if there are more.
const ACCEPTED_SAMPLE: u32 = 1000;
const CONTROL_SAMPLE: u32 = 500;
/// Candidates whose features are in memory at a time.
const PAGE: usize = 32;
/// Largest number of atoms of each element from which the axes follow.
const MAX_ATOMS: usize = 2048;

/// Sampled structures with their features.
#[derive(Default)]
pub struct MapSample {
    version: Option<u32>,
    accepted: ShownPart,
    control: ShownPart,
    structures: Vec<MappedStructure>,
    /// Of each element: points, and features of atoms.
    elements: BTreeMap<Species, MapElement>,
    dimension: usize,
}

struct MapElement {
    points: Vec<FeaturePoint>,
    atoms: SystematicSample<Vec<f64>>,
}

/// Reads structures that walks with the newest version of the potential found.
pub async fn read(store: &Store) -> Result<MapSample, StoreError> {
    // Walks are in the store before their candidates: none up to this one is of a version that is not known yet.
    let newest = store.newest_candidate().await?;
    let versions = store.walk_versions().await?;
    let version = versions.newest();
    let protocol = store.protocol_in_force().await?.map(|protocol| protocol.hash);
    let mut sample =
        MapSample { version: (!versions.is_single()).then_some(version), ..MapSample::default() };
    let mut parts = [ShownPart::default(); 2];
    for ((origin, room), part) in
        [(Origin::Biased, ACCEPTED_SAMPLE), (Origin::Control, CONTROL_SAMPLE)].into_iter().zip(&mut parts)
    {
        let mut chosen = store.sampled_decisions(origin, versions.walks_of(version), room).await?;
        chosen.decisions.retain(|decision| *decision <= newest);
        let before = sample.structures.len();
        for page in chosen.decisions.chunks(PAGE) {
            store.collected_features(protocol, page).await?.iter().for_each(|found| sample.add(found));
        }
        *part = ShownPart { all: chosen.total, shown: (sample.structures.len() - before) as u64 };
    }
    [sample.accepted, sample.control] = parts;
    Ok(sample)
}

impl MapSample {
    /// The map. `initial` is the mixture that the version began with, if it is known. May take seconds.
    pub fn into_map(self, initial: Option<&InitialMixture>) -> FeatureSpaceMap {
        let planes = self.planes(initial);
        let Self { version, accepted, control, structures, dimension, .. } = self;
        FeatureSpaceMap { version, dimension, accepted, control, structures, planes }
    }

    /// Adds a candidate, if the store has its features.
    fn add(&mut self, found: &CollectedFeatures) {
        let view = found.block.view();
        let species = view.structure().species;
        let Some(features) = found.features.as_deref() else { return };
        let dimension = features.len().checked_div(species.len()).unwrap_or(0);
        if dimension == 0 || (self.dimension != 0 && self.dimension != dimension) {
            return;
        }
        self.dimension = dimension;
        let rows: Vec<_> = features.chunks_exact(dimension).collect();
        let mut atoms_of: BTreeMap<Species, Vec<usize>> = BTreeMap::new();
        species.iter().enumerate().for_each(|(atom, of)| atoms_of.entry(*of).or_default().push(atom));
        for (element, atoms) in atoms_of {
            let sample = self.elements.entry(element).or_insert_with(|| MapElement {
                points: Vec::new(),
                atoms: SystematicSample::new(MAX_ATOMS),
            });
            atoms.iter().for_each(|atom| sample.atoms.add_with(|| rows[*atom].to_vec()));
            let value = |values: &[f64], atom: usize| {
                values.get(atom).copied().filter(|x| x.is_finite()).unwrap_or(f64::NEG_INFINITY)
            };
            let grade = |atom: &usize| value(&found.original.gamma, *atom);
            let Some(atom) = atoms.iter().copied().max_by(|a, b| grade(a).total_cmp(&grade(b))) else {
                continue;
            };
            let error = |atom: &usize| {
                let (model, label) = (view.forces.get(*atom)?, found.label_forces.as_ref()?.get(*atom)?);
                Some(norm(sub(*model, *label)) as f32)
            };
            let current = atoms.iter().map(|atom| value(&found.selector.gamma, *atom));
            let known = |x: f64| x.is_finite().then_some(x as f32);
            sample.points.push(FeaturePoint {
                at: rows[atom].to_vec(),
                mean: mean(&rows, &atoms),
                point: MapPoint {
                    structure: self.structures.len(),
                    element: element.symbol(),
                    atom,
                    at: [0.0; 2],
                    mean: [0.0; 2],
                    gamma: known(grade(&atom)),
                    gamma_current: known(current.fold(f64::NEG_INFINITY, f64::max)),
                    force_error: atoms.iter().filter_map(error).reduce(f32::max),
                },
            });
        }
        let id = view.id();
        self.structures.push(MappedStructure {
            id: id.to_string(),
            origin: view.origin().name(),
            walk: id.walk.0,
            step: id.step,
        });
    }

    fn planes(&self, initial: Option<&InitialMixture>) -> Vec<MapPlane> {
        let mut elements: Vec<_> = self.elements.iter().collect();
        elements.sort_by_key(|(element, sample)| (std::cmp::Reverse(sample.atoms.total()), **element));
        let all = (elements.len() > 1).then(|| self.plane(None, &elements, initial));
        let one = elements.iter().take(MAX_ELEMENTS);
        let one = one.map(|one| self.plane(Some(one.0.symbol()), std::slice::from_ref(one), initial));
        all.into_iter().chain(one).flatten().collect()
    }

    fn plane(
        &self,
        name: Option<&'static str>,
        elements: &[(&Species, &MapElement)],
        initial: Option<&InitialMixture>,
    ) -> Option<MapPlane> {
        let components: Vec<_> =
            elements.iter().flat_map(|(element, _)| components(element, initial)).collect();
        let rows = elements.iter().flat_map(|(_, sample)| sample.atoms.items());
        let rows: Vec<f64> = rows.flatten().copied().collect();
        let points: Vec<_> = elements.iter().flat_map(|(_, sample)| &sample.points).collect();
        plane(name, &components, &rows, self.dimension, &points)
    }
}

/// The components of an element; none without the mixture.
fn components(element: &Species, initial: Option<&InitialMixture>) -> Vec<NumberedComponent> {
    let found = initial.and_then(|initial| {
        let index = initial.symbols.iter().position(|symbol| symbol == element.symbol())?;
        initial.mixture.components(index)
    });
    let numbered = found.unwrap_or_default().iter().enumerate();
    numbered.map(|(number, component)| (element.symbol(), number, Arc::clone(component))).collect()
}

/// The mean of these rows.
fn mean(rows: &[&[f64]], of: &[usize]) -> Vec<f64> {
    let mut mean = vec![0.0; rows.first().map_or(0, |row| row.len())];
    for atom in of {
        mean.iter_mut().zip(rows[*atom]).for_each(|(mean, x)| *mean += x / of.len() as f64);
    }
    mean
}
