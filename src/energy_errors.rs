//! How far the potential's energies are from those of labels, without the difference of their zeros.

use analysis::{EnergyOffsets, Thinned, TooFewLabels, quantile};
use atoms::{Species, Structure};
use serde::Serialize;
use store::{Store, StoreError};
use wire::ContentHash;
use workers::labeller::{energy_offsets, labelled_energy};

/// So many labelled structures speak for a composition whose energy errors are shown: one alone would have none.
const MIN_SUPPORT: f64 = 2.0;
/// Structures that quantiles come from, at most; of more a sample.
const MAX_SAMPLES: usize = 1 << 20;

/// The zeros of the labels of one protocol, against that of the potential.
#[derive(Clone, Debug)]
pub struct EnergyReference(Result<EnergyOffsets, TooFewLabels>);

/// They, for people and for programs.
#[derive(Clone, Debug, Serialize)]
pub struct OffsetSummary {
    /// Labelled structures that the fit used; 0 without one.
    pub structures: usize,
    /// Those that it left out because they are too far from the others.
    pub left_out: usize,
    /// The elements' offsets; none without a fit.
    pub elements: Vec<OffsetEntry>,
    /// All of it in words; why there is no fit.
    pub note: String,
}

/// The offset of an element.
#[derive(Clone, Debug, Serialize)]
pub struct OffsetEntry {
    /// Symbol.
    pub element: &'static str,
    /// E_label − E_model of an atom, eV.
    pub offset: f64,
    /// Whether the labelled compositions tell the element apart from others; if not, only sums over compositions count.
    pub separate: bool,
}

/// Energy errors of labelled structures.
#[derive(Clone, Debug)]
pub struct EnergyErrors {
    reference: EnergyReference,
    /// Absolute values, eV an atom.
    errors: Thinned<f64>,
    sum: f64,
    largest: f64,
    left_out: u64,
}

/// What they come to.
#[derive(Clone, Debug, Serialize)]
pub struct EnergySummary {
    /// Labelled structures with an error.
    pub structures: u64,
    /// Those without: too few labels speak for their compositions.
    pub left_out: u64,
    /// Mean of |E_model − E_label| without the offsets, eV an atom; `None` without any structure, as are those that follow.
    pub mean: Option<f64>,
    /// Median, eV an atom.
    pub median: Option<f64>,
    /// 90 % are smaller, eV an atom.
    pub p90: Option<f64>,
    /// The largest, eV an atom.
    pub largest: Option<f64>,
    /// What was taken out.
    pub offsets: OffsetSummary,
}

impl EnergyReference {
    /// Fits the offsets of the elements to labels of this protocol.
    pub async fn fit(store: &Store, protocol: ContentHash) -> Result<Self, StoreError> {
        energy_offsets(store, protocol).await.map(Self)
    }

    /// (E_model − E_label) an atom without the offsets, eV; `None` if too few labels speak for the composition.
    pub fn error_per_atom(&self, structure: &Structure, model: f64, label: f64) -> Option<f64> {
        let found = labelled_energy(structure, model, label);
        self.0.as_ref().ok()?.error_per_atom(&found, MIN_SUPPORT).filter(|error| error.is_finite())
    }

    /// What is shown of them.
    pub fn summary(&self) -> OffsetSummary {
        let note = self.note();
        let Ok(fit) = &self.0 else {
            return OffsetSummary { structures: 0, left_out: 0, elements: Vec::new(), note };
        };
        let elements = fit.elements().map(|found| OffsetEntry {
            element: Species::from_atomic_number(found.element).map_or("?", Species::symbol),
            offset: found.offset,
            separate: found.is_separate,
        });
        OffsetSummary {
            structures: fit.structures(),
            left_out: fit.left_out(),
            elements: elements.collect(),
            note,
        }
    }

    fn note(&self) -> String {
        let fit = match &self.0 {
            Ok(fit) => fit,
            Err(TooFewLabels { structures, needed }) => {
                return format!(
                    "no energy errors: labels and the potential have other reference of energy, and the offsets of the elements take \
                     at least {needed} labelled structures; there {}",
                    match structures {
                        1 => "is 1".to_owned(),
                        n => format!("are {n}"),
                    }
                );
            }
        };
        let elements: Vec<_> = fit.elements().collect();
        let symbol = |element: u8| Species::from_atomic_number(element).map_or("?", Species::symbol);
        let offset =
            |found: &analysis::ElementOffset| format!("{} {:.4}", symbol(found.element), found.offset);
        let offsets: Vec<_> = elements.iter().map(offset).collect();
        let mut note = format!(
            "energy errors are without the offsets of the elements (eV an atom, E_label − E_model): {}; least squares over {} labelled \
             structures",
            offsets.join(", "),
            fit.structures()
        );
        if fit.left_out() > 0 {
            note += &format!(", without {} that are too far from the others", fit.left_out());
        }
        let together: Vec<_> = elements.iter().filter(|found| !found.is_separate).collect();
        if !together.is_empty() {
            let symbols: Vec<_> = together.iter().map(|found| symbol(found.element)).collect();
            note += &format!(
                "; the labelled compositions do not tell {} apart, and only sums of their offsets count",
                symbols.join(", ")
            );
        }
        note
    }
}

impl EnergyErrors {
    /// Of no structure yet.
    pub fn new(reference: EnergyReference) -> Self {
        Self { reference, errors: Thinned::new(MAX_SAMPLES), sum: 0.0, largest: 0.0, left_out: 0 }
    }

    /// A labelled structure with its energies, eV.
    pub fn add(&mut self, structure: &Structure, model: f64, label: f64) {
        match self.reference.error_per_atom(structure, model, label) {
            Some(error) => {
                self.errors.push(error.abs());
                self.sum += error.abs();
                self.largest = self.largest.max(error.abs());
            }
            None => self.left_out += 1,
        }
    }

    /// What they come to.
    pub fn summary(&self) -> EnergySummary {
        let mut sorted: Vec<f64> = self.errors.kept().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let structures = self.errors.seen();
        let any = |x: f64| (structures > 0).then_some(x);
        EnergySummary {
            structures,
            left_out: self.left_out,
            mean: any(self.sum / structures.max(1) as f64),
            median: quantile(&sorted, 0.5),
            p90: quantile(&sorted, 0.9),
            largest: any(self.largest),
            offsets: self.reference.summary(),
        }
    }
}

impl EnergySummary {
    /// Without the note: in one line, meV an atom; `None` if there is no error to show.
    pub fn line(&self) -> Option<String> {
        let milli = |x: Option<f64>| crate::output::decimals(x.map(|x| 1000.0 * x), 1);
        self.mean?;
        let mut line = format!(
            "mean {}, median {}, 90 % below {}, largest {} meV/atom, over {} structures",
            milli(self.mean),
            milli(self.median),
            milli(self.p90),
            milli(self.largest),
            self.structures
        );
        if self.left_out > 0 {
            line += &format!(" ({} more have compositions for which too few labels speak)", self.left_out);
        }
        Some(line)
    }
}
