//! Bounds of the force error for structures that `calm score` grades, from the labels of a campaign.

use std::path::Path;

use atoms::Structure;
use monitor::calibration;
use store::Store;

use crate::calibration_file::{CalibrationFile, GradeFiles};
use crate::cli::{CommandError, block_on, campaign_location};
use crate::output::count;
use crate::wording;

/// Name of the column.
pub const COLUMN: &str = "force_error_bound";

/// The bounds of the version whose model and artifact grade the structures.
pub struct ScoreCalibration {
    file: CalibrationFile,
    /// Structures whose worst atom has no bound.
    without: u64,
}

impl ScoreCalibration {
    /// From a campaign, or from a file that `calmwalk force-errors --calibration` wrote.
    ///
    /// # Errors
    /// Neither of the two; a model or artifact that the bounds do not belong to.
    pub fn load(source: &Path, model: &Path, artifact: Option<&Path>) -> Result<Self, CommandError> {
        let graded = GradeFiles::of_paths(model, artifact)?;
        let file = match source.is_file() {
            true => from_file(source, &graded)?,
            false => block_on(from_campaign(source, &graded))??,
        };
        Ok(Self { file, without: 0 })
    }

    /// The bound of |ΔF|, eV/Å, of the atom with the largest γ_nbr. `None` without enough labels in its bin.
    pub fn bound(&mut self, structure: &Structure, gamma_nbr: &[f64]) -> Option<f64> {
        let atoms = structure.species.iter().zip(gamma_nbr);
        let worst = atoms.max_by(|a, b| a.1.total_cmp(b.1));
        let summary = &self.file.summary;
        let bound = worst.and_then(|(species, grade)| summary.bound(*grade, species.symbol()));
        self.without += u64::from(bound.is_none());
        bound
    }

    /// What is said at the end.
    pub fn note(&self) -> String {
        let CalibrationFile { protocol, summary, .. } = &self.file;
        let without = match self.without {
            0 => String::new(),
            number => format!(
                "; {} without a bound: too few labels at the γ_nbr of the worst atom",
                count(number, "structure")
            ),
        };
        format!(
            "{COLUMN} from labels of protocol '{protocol}', version {} of the potential: {}{without}",
            summary.version,
            wording::calibration::sentence(summary)
        )
    }
}

fn from_file(path: &Path, graded: &GradeFiles) -> Result<CalibrationFile, CommandError> {
    let file = CalibrationFile::load(path)?;
    if file.files == *graded {
        return Ok(file);
    }
    let GradeFiles { model_hash, mixture_hash } = &file.files;
    let what = match *model_hash == graded.model_hash {
        true => format!("the artifact is another one than {}", described(mixture_hash.as_deref())),
        false => format!("the model is another one than {model_hash}"),
    };
    Err(CommandError::Input(format!(
        "{}: the bounds belong to version {} of the potential of campaign {}, {what} (BLAKE3)",
        path.display(),
        file.summary.version,
        file.campaign
    )))
}

fn described(mixture: Option<&str>) -> String {
    mixture.map_or_else(|| "the mixture in the model's file".to_owned(), str::to_owned)
}

/// Of the newest version with these files that has labels.
async fn from_campaign(source: &Path, graded: &GradeFiles) -> Result<CalibrationFile, CommandError> {
    let store = Store::open_read_only(&campaign_location::parse(source)?).await?;
    let none = || {
        CommandError::Input("--calibration: the campaign has no labels: it has no label protocol yet".into())
    };
    let protocol = store.protocol_in_force().await?.ok_or_else(none)?;
    let mut found = None;
    for version in store.walk_versions().await?.numbers() {
        if GradeFiles::of_version(&store, version).await? != *graded {
            continue;
        }
        let summary = calibration::read(&store, protocol.hash, version).await?.summary();
        if found.is_none() || summary.structures() > 0 {
            found = Some(CalibrationFile::new(&store, &protocol, summary).await?);
        }
    }
    store.close().await;
    found.ok_or_else(|| {
        CommandError::Input(format!(
            "--calibration: no version of the potential of the campaign has this model (BLAKE3 {}) with {}; grades of another \
             version have other bounds",
            graded.model_hash,
            match &graded.mixture_hash {
                Some(hash) => format!("this artifact ({hash})"),
                None => "the mixture in its file; expected --artifact if the campaign has one".to_owned(),
            }
        ))
    })
}
