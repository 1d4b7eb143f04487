//! Reads the seed structures and checks that walks can start from them.

use std::collections::HashMap;
use std::mem;
use std::num::NonZeroUsize;
use std::path::PathBuf;

use atoms::{CloseContact, Repetition, Structure, extxyz, read_structures};
use calm::rules::Positive;
use md::BarostatSettings;
use orchestrator::selector::SeedStructurePlan;
use potentials::ModelWithFeatures;
use toml::Spanned;
use wire::ContentHash;

use super::geometry::{Geometry, cell_bias_fault};
use super::loader::Loader;
use crate::all_cores;
use crate::config::{ConfigError, OnInvalid, WalkSection, Warning, location};

const FILES: &str = "seed_structures.files";

/// Nearest neighbours of solids and molecules are 0.79 to 1.48 times the sum of their radii (U, H₂) apart. Confusing
/// Bohr and Å changes distances by a factor of 1.89.
const USUAL_BONDS: std::ops::RangeInclusive<f64> = 0.65..=1.5;

/// Number of seed structures that are listed with the same kind of warning.
const MAX_LISTED: usize = 20;

/// Largest supercell: a walk of a larger one takes weeks.
const MAX_SUPERCELL_ATOMS: u64 = 100_000;

/// A seed structure and its source.
#[derive(Clone)]
pub struct SourcedStructure {
    /// Its name, structure and walks.
    pub plan: SeedStructurePlan,
    /// `file:line`, and the repetition of a supercell.
    pub source: String,
    /// Repetition of the cell in the file.
    pub repetition: Repetition,
    /// Its distances.
    pub geometry: Geometry,
}

/// The seed structures of a campaign.
#[derive(Default)]
pub struct SeedStructures {
    /// Those that walks start from.
    pub valid: Vec<SourcedStructure>,
    /// Those that no walk can start from.
    pub skipped: Vec<SkippedStructure>,
}

/// A seed structure that is left out.
#[derive(Clone)]
pub struct SkippedStructure {
    /// Its name and structure; no walks.
    pub plan: SeedStructurePlan,
    /// `file:line`
    pub source: String,
    /// Why no walk can start from it.
    pub reason: String,
}

impl SeedStructures {
    /// Leaves out the structures for which there is a reason.
    pub fn skip(&mut self, mut reason: impl FnMut(&SourcedStructure) -> Option<String>) {
        for named in mem::take(&mut self.valid) {
            match reason(&named) {
                None => self.valid.push(named),
                Some(reason) => {
                    let SourcedStructure { plan, source, .. } = named;
                    self.skipped.push(SkippedStructure { plan, source, reason });
                }
            }
        }
    }
}

impl SkippedStructure {
    fn message(&self) -> String {
        let Self { plan, source, reason } = self;
        format!("seed structure '{}' ({source}) is skipped: {reason}", plan.name)
    }
}

/// A frame of a file.
struct SourcedFrame<'a> {
    plan: SeedStructurePlan,
    /// `file:line`, and the repetition of a supercell.
    source: String,
    repetition: Repetition,
    /// The file as the configuration names it.
    file: &'a Spanned<PathBuf>,
}

impl Loader<'_> {
    /// Reads every frame of every file. Names must be unique. Frames that no walk can start from are left out, with a
    /// reason each, if the configuration allows it and others remain.
    pub fn seed_structures(&self, model: &dyn ModelWithFeatures) -> Result<SeedStructures, ConfigError> {
        let frames = self.read_seed_structures()?.into_iter();
        let examined = all_cores::map(
            frames,
            || (),
            |(), mut frame| {
                let geometry = self
                    .make_supercell(&mut frame)
                    .and_then(|()| self.check_seed_structure(&frame.plan.structure, model));
                (frame, geometry)
            },
        );
        let (mut seeds, mut first_error) = (SeedStructures::default(), None);
        for (SourcedFrame { plan, source, repetition, file }, geometry) in examined {
            let reason = match geometry {
                Ok(geometry) => {
                    seeds.valid.push(SourcedStructure { plan, source, repetition, geometry });
                    continue;
                }
                Err(reason) => reason,
            };
            let error = || self.file_error(FILES, file, format!("{source}: {reason}"));
            if self.config.seed_structures.on_invalid == OnInvalid::Error {
                return Err(error());
            }
            first_error.get_or_insert_with(error);
            seeds.skipped.push(SkippedStructure { plan, source, reason });
        }
        match first_error.filter(|_| seeds.valid.is_empty()) {
            Some(error) => Err(error),
            None => Ok(seeds),
        }
    }

    /// Reads every frame of every file, in order, and names it.
    fn read_seed_structures(&self) -> Result<Vec<SourcedFrame<'_>>, ConfigError> {
        let mut all = Vec::new();
        let mut sources: HashMap<String, String> = HashMap::new();
        for file in &self.config.seed_structures.files {
            let path = file.get_ref();
            let wrong = |message: String| self.file_error(FILES, file, message);
            let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let frames = read_structures(path).map_err(|error| wrong(error.to_string()))?;
            for (number, frame) in frames.into_iter().enumerate() {
                let source = format!("{}:{}", path.display(), frame.line);
                let named = frame.info.get("name").and_then(extxyz::ExtxyzValue::text).map(str::to_owned);
                let name = named.unwrap_or_else(|| format!("{stem}-{number}"));
                if let Some(first) = sources.insert(name.clone(), source.clone()) {
                    return Err(wrong(format!(
                        "{source}: a second seed structure named '{name}', the first is {first}; give each a unique name \
                         (name=… in its comment line)",
                    )));
                }
                let plan = SeedStructurePlan { name, structure: frame.structure, walks: Vec::new() };
                all.push(SourcedFrame { plan, source, repetition: Repetition::ONE, file });
            }
        }
        Ok(all)
    }

    /// Repeats a cell that is smaller than `min_atoms` or `min_height`.
    fn make_supercell(&self, frame: &mut SourcedFrame<'_>) -> Result<(), String> {
        let section = &self.config.seed_structures;
        let structure = &frame.plan.structure;
        structure.validate().map_err(|error| error.to_string())?;
        let min_atoms = section.min_atoms.map_or(1, NonZeroUsize::get);
        let min_height = section.min_height.map_or(0.0, Positive::get);
        let repetition = Repetition::for_size(structure, min_atoms, min_height);
        if repetition == Repetition::ONE {
            return Ok(());
        }
        let atoms = repetition.cells().saturating_mul(structure.len() as u64);
        if atoms > MAX_SUPERCELL_ATOMS {
            return Err(format!(
                "seed_structures.min_atoms and min_height ask for a supercell of {repetition} cells with {atoms} atoms, more \
                 than {MAX_SUPERCELL_ATOMS}"
            ));
        }
        frame.plan.structure = structure.repeated(repetition);
        frame.source = format!("{}, {repetition} supercell", frame.source);
        frame.repetition = repetition;
        Ok(())
    }

    /// Checks that a walk can start and collect: the model knows the elements, no atoms overlap, each atom has a
    /// neighbour, there are as many atoms as the collection rule requires, and a volume ramp has a cell.
    fn check_seed_structure(
        &self,
        structure: &Structure,
        model: &dyn ModelWithFeatures,
    ) -> Result<Geometry, String> {
        model.element_indices(&structure.species).map_err(|error| error.to_string())?;
        let geometry = Geometry::new(structure, model.cutoff()).map_err(|error| error.to_string())?;
        if let Some(contact) = self.config.guard.min_distances.prevents_start(&geometry.shortest) {
            let CloseContact { pair, distance, limit } = contact;
            let closest = geometry
                .closest
                .map_or(String::new(), |(i, j, d)| format!(" (atoms {i} and {j} are {d:.3} Å apart)"));
            return Err(format!(
                "the shortest {pair} distance is {distance:.3} Å, below the {limit:.3} Å that guard.min_distances allows at \
                 the start of a walk{closest}"
            ));
        }
        if let Some(atom) = geometry.isolated {
            let cutoff = model.cutoff();
            return Err(format!(
                "atom {atom} has no neighbour within the cutoff, {cutoff} Å: a walk would end at its first step (are \
                 positions and cell in Å, not Bohr?)"
            ));
        }
        self.check_collectable(structure)?;
        Ok(geometry)
    }

    fn check_collectable(&self, structure: &Structure) -> Result<(), String> {
        let atoms = structure.len();
        if let Some((needed, key)) = self.config.collect.criterion.too_small(atoms) {
            return Err(format!(
                "the structure has {atoms} atoms, fewer than the {needed} that must be new at once \
                 (collect.criterion.{key}): nothing can ever be collected from it; give a larger cell (seed_structures.min_atoms makes supercells) or a \
                 smaller `{key}`"
            ));
        }
        // Groups of walks say for themselves which of them change the volume.
        if !self.config.walks.is_empty() {
            return Ok(());
        }
        let WalkSection { volume_ramp, barostat, cell_bias, temperature, thermostat, .. } = &self.config.walk;
        if volume_ramp.is_some() && structure.periodic == [false; 3] {
            return Err(
                "the structure has no periodic direction, and so no volume for walk.volume_ramp to change; give it a \
                 cell (Lattice=… in its comment line), or leave walk.volume_ramp out"
                    .to_owned(),
            );
        }
        let fault = |barostat: &BarostatSettings| barostat.fault(temperature.get(), thermostat, structure);
        if let Some(fault) = barostat.as_ref().and_then(fault) {
            return Err(format!("walk.barostat: {fault}"));
        }
        if let Some(fault) = cell_bias.and_then(|_| cell_bias_fault(structure)) {
            return Err(format!("walk.cell_bias: {fault}"));
        }
        Ok(())
    }

    /// Checks that there is a cluster where there is a wall.
    pub fn check_wall(&self, seeds: &SeedStructures) -> Result<(), ConfigError> {
        let is_cluster = |seed: &SourcedStructure| seed.plan.structure.periodic == [false; 3];
        if self.config.guard.wall.is_none() || seeds.valid.iter().any(is_cluster) {
            return Ok(());
        }
        let key = "guard.wall".to_owned();
        let message =
            "a wall holds clusters together, and every seed structure is periodic; leave it out".to_owned();
        Err(ConfigError::File { at: location(self.path, self.text, &key), key, message })
    }

    /// Warns of skipped structures, and of likely mistakes: duplicate structures and distances that do not match the
    /// elements.
    pub fn suspicious_seed_structures(&self, seeds: &SeedStructures) -> Vec<Warning> {
        let at = location(self.path, self.text, FILES);
        let warning = |message| Warning { at: at.clone(), key: FILES.to_owned(), message };
        let (mut same, mut strange, mut first) = (Vec::new(), Vec::new(), HashMap::new());
        for named in &seeds.valid {
            let SourcedStructure {
                plan: SeedStructurePlan { name, structure, .. }, source, geometry, ..
            } = named;
            if let Some(other) = first.insert(ContentHash::from_structure(&rounded(structure)), named) {
                same.push(format!(
                    "seed structure '{name}' ({source}) is the same as '{}' ({}): walks from it find few new structures",
                    other.plan.name, other.source
                ));
            }
            if let Some(distances) = suspicious_distances(structure, geometry) {
                strange.push(format!("seed structure '{name}' ({source}): {distances}"));
            }
        }
        let skipped = seeds.skipped.iter().map(SkippedStructure::message).collect();
        let messages = [
            listed(skipped, "are skipped (calmwalk validate --csv FILE lists all)"),
            listed(same, "are the same as another one"),
            listed(strange, "have unusual distances between neighbours"),
        ];
        messages.into_iter().flatten().map(warning).collect()
    }
}

/// The first messages, and how many more seed structures they concern.
pub(super) fn listed(mut messages: Vec<String>, what: &str) -> Vec<String> {
    if let Some(more @ 1..) = messages.len().checked_sub(MAX_LISTED) {
        messages.truncate(MAX_LISTED);
        messages.push(format!("{more} more seed structures {what}"));
    }
    messages
}

/// The structure with lengths rounded to the precision of files, Å.
fn rounded(structure: &Structure) -> Structure {
    const DIGIT: f64 = 1e-4;
    let mut structure = structure.clone();
    let lengths = structure.cell.0.iter_mut().chain(&mut structure.positions).flatten();
    // Turns −0 into 0.
    lengths.for_each(|x| *x = (*x / DIGIT).round() * DIGIT + 0.0);
    structure
}

/// Describes nearest-neighbour distances that do not match the elements.
fn suspicious_distances(structure: &Structure, geometry: &Geometry) -> Option<String> {
    let (distance, ratio) = geometry.nearest?;
    if USUAL_BONDS.contains(&ratio) {
        return None;
    }
    let mass: f64 = structure.species.iter().map(|species| species.mass()).sum();
    let density = match structure.periodic {
        // 1 u/Å³ in g/cm³.
        [true, true, true] => format!(", at {:.2} g/cm³", 1.660_539 * mass / structure.cell.volume()),
        _ => String::new(),
    };
    let instead = if ratio > 1.0 { "Bohr" } else { "nm, or in Å scaled to Bohr" };
    Some(format!(
        "nearest neighbours are {distance:.2} Å apart, {ratio:.2} times the sum of their radii{density}: are positions and \
         cell in {instead}? expected Å"
    ))
}
