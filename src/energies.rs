//! How far the potential's energies are from those of labels, without the difference of their zeros.

use analysis::{EnergyOffsets, SystematicSample, TooFewLabels, quantile};
use atoms::{Species, Structure};
use serde::Serialize;
use store::{Store, StoreError};
use wire::ContentHash;
use workers::labeller::{energy_offsets, labelled_energy};

/// So many labelled structures speak for a composition whose energy errors are shown: one alone would have none.
const LEAST_SUPPORT: f64 = 2.0;
/// Structures that quantiles come from, at most; of more a sample.
const ROOM: usize = 1 << 20;

/// The zeros of the labels of one protocol, against that of the potential.
#[derive(Clone, Debug)]
pub struct Zeros(Result<EnergyOffsets, TooFewLabels>);

/// They, for people and for programs.
#[derive(Clone, Debug, Serialize)]
pub struct Offsets {
    /// Labelled structures that the fit used; 0 without one.
    pub structures: usize,
    /// Those that it left out because they are too far from the others.
    pub left_out: usize,
    /// The elements' offsets; none without a fit.
    pub elements: Vec<Offset>,
    /// All of it in words; why there is no fit.
    pub note: String,
}

/// The offset of an element.
#[derive(Clone, Debug, Serialize)]
pub struct Offset {
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
    zeros: Zeros,
    /// Absolute values, eV an atom.
    errors: SystematicSample<f64>,
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
    pub offsets: Offsets,
}

impl Zeros {
    /// Fits the offsets of the elements to labels of this protocol.
    pub async fn read(store: &Store, protocol: ContentHash) -> Result<Self, StoreError> {
        energy_offsets(store, protocol).await.map(Self)
    }

    /// (E_model − E_label) an atom without the offsets, eV; `None` if too few labels speak for the composition.
    pub fn error_per_atom(&self, structure: &Structure, model: f64, label: f64) -> Option<f64> {
        let found = labelled_energy(structure, model, label);
        self.0.as_ref().ok()?.error_per_atom(&found, LEAST_SUPPORT).filter(|error| error.is_finite())
    }

    /// What is shown of them.
    pub fn shown(&self) -> Offsets {
        let note = self.note();
        let Ok(fit) = &self.0 else {
            return Offsets { structures: 0, left_out: 0, elements: Vec::new(), note };
        };
        let elements = fit.elements().map(|found| Offset {
            element: Species::from_atomic_number(found.element).map_or("?", Species::symbol),
            offset: found.offset,
            separate: found.is_separate,
        });
        Offsets { structures: fit.structures(), left_out: fit.left_out(), elements: elements.collect(), note }
    }

    fn note(&self) -> String {
        let fit = match &self.0 {
            Ok(fit) => fit,
            Err(TooFewLabels { structures, needed }) => {
                return format!(
                    "no energy errors: labels and the potential have other zeros of energy, and the offsets of the elements take \
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
    pub fn new(zeros: Zeros) -> Self {
        Self { zeros, errors: SystematicSample::new(ROOM), sum: 0.0, largest: 0.0, left_out: 0 }
    }

    /// A labelled structure with its energies, eV.
    pub fn push(&mut self, structure: &Structure, model: f64, label: f64) {
        match self.zeros.error_per_atom(structure, model, label) {
            Some(error) => {
                self.errors.add(error.abs());
                self.sum += error.abs();
                self.largest = self.largest.max(error.abs());
            }
            None => self.left_out += 1,
        }
    }

    /// What they come to.
    pub fn summary(&self) -> EnergySummary {
        let mut sorted: Vec<f64> = self.errors.items().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let structures = self.errors.total();
        let any = |x: f64| (structures > 0).then_some(x);
        EnergySummary {
            structures,
            left_out: self.left_out,
            mean: any(self.sum / structures.max(1) as f64),
            median: quantile(&sorted, 0.5),
            p90: quantile(&sorted, 0.9),
            largest: any(self.largest),
            offsets: self.zeros.shown(),
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
