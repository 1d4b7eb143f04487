//! Reads the structures of `label.reference_check`, and warns if their labels are unlikely to be those of the reference.

use std::collections::{BTreeSet, HashMap};
use std::path::PathBuf;
use std::sync::Arc;

use atoms::cell::norm;
use atoms::{Evaluation, NeighbourList, Species, Vec3};
use monitor::reference_check::KnownStructure;
use potentials::ModelWithFeatures;
use potentials::grace::Threads;
use toml::Spanned;
use wire::ContentHash;

use super::loader::Loader;
use crate::config::{ConfigError, Warning};
use crate::label_method;
use crate::output::count;
use crate::xyz_reader::{XyzReader, label};

const STRUCTURES: &str = "label.reference_check.structures";

/// Forces of the reference that are larger or smaller than the potential's by more than this factor may have other units:
/// 1 Ha/Bohr is 51.4 eV/Å, 1 eV/Å is 23.1 kcal/mol/Å.
const USUAL_FORCE_RATIO: std::ops::RangeInclusive<f64> = 0.5..=2.0;

impl Loader<'_> {
    /// The structures of the check with what is known of them, none without a check, and warnings.
    pub fn known_structures(
        &self,
        model: &Arc<dyn ModelWithFeatures>,
    ) -> Result<(Vec<KnownStructure>, Vec<Warning>), ConfigError> {
        let Some(file) = &self.config.label.reference_check.structures else {
            return Ok((Vec::new(), Vec::new()));
        };
        let wrong = |message: String| self.file_error(STRUCTURES, file, message);
        let frames = XyzReader::open(file.get_ref()).map_err(|error| wrong(error.to_string()))?;
        let (mut known, mut sources) = (Vec::new(), HashMap::new());
        for frame in frames {
            let frame = frame.map_err(|error| wrong(error.to_string()))?;
            let source = format!("{}:{}", file.get_ref().display(), frame.line);
            let of_frame = |message: String| wrong(format!("{source}: {message}"));
            let label = label(&frame).map_err(of_frame)?;
            frame.structure.validate().map_err(|error| of_frame(error.to_string()))?;
            let refused =
                self.config.label.bounds().rejects(label.energy, &label.forces, label.stress.as_ref());
            if let Some(refused) = refused {
                return Err(of_frame(format!(
                    "{refused} (energies in eV, forces in eV/Å, stresses in eV/Å³)"
                )));
            }
            let content = ContentHash::from_structure(&frame.structure);
            if let Some(first) = sources.insert(content.0, source.clone()) {
                return Err(of_frame(format!("the same structure as {first}; expected each structure once")));
            }
            known.push(KnownStructure { source, structure: frame.structure, label });
        }
        if known.is_empty() {
            return Err(wrong(format!("{}: no structure; expected at least one", file.get_ref().display())));
        }
        let species = elements(&known);
        label_method::supports(&self.config.label, &species)
            .map_err(|error| wrong(format!("{}: {error}", file.get_ref().display())))?;
        let warnings = self.suspicious_known(file, &known, model);
        Ok((known, warnings))
    }

    fn suspicious_known(
        &self,
        file: &Spanned<PathBuf>,
        known: &[KnownStructure],
        model: &Arc<dyn ModelWithFeatures>,
    ) -> Vec<Warning> {
        let (needed, bounds) = (elements(known).len() + 1, self.config.label.reference_check.bounds());
        let few = (known.len() < needed).then(|| {
            format!(
                "{} with {}: energies cannot be compared, since the offsets of the elements absorb every \
                 difference; give at least {needed}. Forces and stresses are compared",
                count(known.len(), "structure"),
                count(needed - 1, "element")
            )
        });
        let forces = known.iter().flat_map(|known| &known.label.forces);
        let largest = forces.map(|force| norm(*force)).fold(0.0, f64::max);
        let small = (largest <= bounds.force).then(|| {
            format!(
                "the largest force is {largest:.4} eV/Å, within label.reference_check.max_force_difference: forces that are wrong would not \
                 be noticed; add structures with displaced atoms"
            )
        });
        let units = force_ratio(known, model).filter(|ratio| !USUAL_FORCE_RATIO.contains(ratio)).map(|ratio| {
            format!(
                "the forces are {ratio:.3} times those of the potential: are they in eV/Å, and by the reference that the \
                 potential was trained on?"
            )
        });
        let messages = [few, small, units].into_iter().flatten();
        messages.map(|message| self.warning(STRUCTURES, file, message)).collect()
    }
}

fn elements(known: &[KnownStructure]) -> BTreeSet<Species> {
    known.iter().flat_map(|known| known.structure.species.iter().copied()).collect()
}

/// The factor between the potential's forces and the known ones, by least squares. `None` if the potential can evaluate
/// none of the structures, or has no forces there.
fn force_ratio(known: &[KnownStructure], model: &Arc<dyn ModelWithFeatures>) -> Option<f64> {
    let mut potential = Arc::clone(model).evaluator(Threads::default());
    let (mut product, mut square) = (0.0, 0.0);
    for KnownStructure { structure, label, .. } in known {
        let (mut neighbours, mut evaluation) =
            (NeighbourList::new(model.cutoff(), 0.0), Evaluation::default());
        if neighbours.update(structure).is_err()
            || potential.evaluate(structure, &neighbours, &mut evaluation).is_err()
        {
            continue;
        }
        let dot = |a: &[Vec3], b: &[Vec3]| -> f64 {
            a.iter().flatten().zip(b.iter().flatten()).map(|(x, y)| x * y).sum()
        };
        product += dot(&label.forces, &evaluation.forces);
        square += dot(&evaluation.forces, &evaluation.forces);
    }
    // Without forces there is no factor.
    (square > 1e-6).then(|| product / square)
}
