//! Columns that have no index: what rows are sorted by.

use std::cmp::Ordering;

use monitor::candidate_errors::{CandidateErrors, ErrorReader};
use store::{ListedCandidate, Store, StoreError, WalkVersions};

macro_rules! columns {
    ($($column:ident $name:literal),* $(,)?) => {
        /// A column without an index.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum SortColumn {
            $($column),*
        }

        const COLUMNS: &[(&str, SortColumn)] = &[$(($name, SortColumn::$column)),*];
    };
}

columns! {
    Walk "walk", Fate "fate", State "state", Priority "priority", Value "value", GammaCurrent "gamma_current",
    GammaNbr "gamma_nbr", Temperature "temperature", SeedStructure "seed_structure", Formula "formula", Atoms "atoms",
    Energy "energy", PotentialEnergy "potential_energy", EnergyError "energy_error", MaxForce "max_force",
    ForceMae "force_mae", MaxForceError "max_force_error", StressError "stress_error", Attempts "attempts",
    Version "version",
}

/// What a row is sorted by.
#[derive(Clone, Debug, PartialEq)]
pub enum SortValue {
    Number(f64),
    Text(String),
}

/// A row with what belongs to it from elsewhere.
#[derive(Debug)]
pub struct TableRow {
    pub candidate: ListedCandidate,
    /// Version of the potential of its walk.
    pub version: u32,
    /// `None` without a label under the protocol in force.
    pub errors: Option<CandidateErrors>,
}

impl TableRow {
    /// Without its errors.
    pub fn new(candidate: ListedCandidate, versions: &WalkVersions) -> Self {
        Self { version: versions.version_of(candidate.walk), errors: None, candidate }
    }
}

/// Reads the errors of rows that have a label.
pub async fn read_errors(
    rows: &mut [TableRow],
    store: &Store,
    reader: &mut ErrorReader,
) -> Result<(), StoreError> {
    let mut labelled: Vec<_> = rows.iter_mut().filter(|row| row.candidate.energy.is_some()).collect();
    let places: Vec<_> = labelled.iter().map(|row| (row.candidate.decision, row.version)).collect();
    let errors = reader.read(store, &places).await?;
    labelled.iter_mut().zip(errors).for_each(|(row, errors)| row.errors = errors);
    Ok(())
}

impl SortColumn {
    /// The column with a name.
    pub fn named(name: &str) -> Option<Self> {
        COLUMNS.iter().find(|(known, _)| *known == name).map(|(_, column)| *column)
    }

    /// All names.
    pub fn names() -> Vec<&'static str> {
        COLUMNS.iter().map(|(name, _)| *name).collect()
    }

    /// Whether its values are errors, which take long to read.
    pub fn is_error(self) -> bool {
        matches!(self, Self::EnergyError | Self::ForceMae | Self::MaxForceError | Self::StressError)
    }

    /// The value of a row; `None` if there is none. Energies are per atom, their errors without a sign.
    pub fn value(self, row: &TableRow) -> Option<SortValue> {
        let TableRow { candidate, version, errors } = row;
        let per_atom = |energy: Option<f64>| energy.map(|energy| energy / f64::from(candidate.atoms));
        let number = match self {
            Self::Fate => {
                let fate = if candidate.origin == "control" { &candidate.origin } else { &candidate.fate };
                return Some(SortValue::Text(fate.clone()));
            }
            Self::State => return candidate.job_state.clone().map(SortValue::Text),
            Self::SeedStructure => return Some(SortValue::Text(candidate.seed_structure.clone())),
            Self::Formula => return Some(SortValue::Text(candidate.formula.clone())),
            Self::Walk => Some(f64::from(candidate.walk)),
            Self::Priority => candidate.priority.map(f64::from),
            Self::Value => candidate.value,
            Self::GammaCurrent => candidate.selector_gamma,
            Self::GammaNbr => candidate.gamma_nbr,
            Self::Temperature => candidate.temperature,
            Self::Atoms => Some(f64::from(candidate.atoms)),
            Self::Energy => per_atom(candidate.energy),
            Self::PotentialEnergy => per_atom(candidate.potential_energy),
            Self::EnergyError => errors.and_then(|errors| errors.energy).map(f64::abs),
            Self::MaxForce => candidate.max_force,
            Self::ForceMae => errors.and_then(|errors| errors.force_mae),
            Self::MaxForceError => errors.and_then(|errors| errors.max_force_error),
            Self::StressError => errors.and_then(|errors| errors.stress),
            Self::Attempts => candidate.attempts.map(f64::from),
            Self::Version => Some(f64::from(*version)),
        };
        number.filter(|number| number.is_finite()).map(SortValue::Number)
    }
}

impl SortValue {
    /// The order of two values of one column.
    pub fn compare(&self, other: &Self) -> Ordering {
        match (self, other) {
            (Self::Number(a), Self::Number(b)) => a.total_cmp(b),
            (Self::Text(a), Self::Text(b)) => a.cmp(b),
            (Self::Number(_), Self::Text(_)) => Ordering::Less,
            (Self::Text(_), Self::Number(_)) => Ordering::Greater,
        }
    }
}
