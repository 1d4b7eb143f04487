//! The model of a command or a campaign: one that this program evaluates, or one behind a program in Python.

use std::path::Path;
use std::sync::Arc;

use bridge::{AdapterFeatures, Device, PythonModel};
use calm::Projection;
use potentials::ModelWithFeatures;
use potentials::grace::{GraceModel, Precision, RadialPath};
use tokio_util::sync::CancellationToken;

use crate::config::Config;
use crate::exit_status::CommandError;
use crate::file_hash;
use crate::grace_projection::{model_projection, with_projection};
use crate::python_model;

/// A model that is ready to be evaluated.
#[derive(Clone, Debug)]
pub enum LoadedModel {
    /// GRACE, evaluated here.
    Grace(Arc<GraceModel>),
    /// Any other, evaluated by its framework.
    Python(Arc<PythonModel>),
}

impl From<GraceModel> for LoadedModel {
    fn from(model: GraceModel) -> Self {
        Self::Grace(Arc::new(model))
    }
}

impl From<Arc<GraceModel>> for LoadedModel {
    fn from(model: Arc<GraceModel>) -> Self {
        Self::Grace(model)
    }
}

impl LoadedModel {
    /// Loads the model of a command: an export of GRACE, or a file `.toml` with a section `[potential]` as in a campaign's configuration,
    /// whose program is started.
    ///
    /// # Errors
    /// A file that is neither, or a program that does not start.
    pub fn load(path: &Path) -> Result<Self, CommandError> {
        if path.extension().is_some_and(|extension| extension == "toml") {
            return Self::from_configuration(path);
        }
        Self::load_export(path, Precision::default())
    }

    fn load_export(path: &Path, precision: Precision) -> Result<Self, CommandError> {
        let model = GraceModel::load_in(path, precision, RadialPath::default());
        Ok(model.map_err(CommandError::input)?.into())
    }

    /// Loads the model of the section `[potential]` of a file, whatever its name.
    ///
    /// # Errors
    /// As [`LoadedModel::load`].
    pub fn from_configuration(path: &Path) -> Result<Self, CommandError> {
        let potential = Config::load_potential(path).map_err(CommandError::input)?;
        let model = potential.model.get_ref();
        let Some(python) = &potential.python else { return Self::load_export(model, potential.precision) };
        let wrong = |error: String| CommandError::Input(format!("{}: {error}", path.display()));
        let settings = python.settings(model, potential.precision);
        let devices = python_model::start(settings, false, &CancellationToken::new());
        let devices = devices.map_err(|error| wrong(error.to_string()))?;
        Ok(Self::Python(Arc::new(PythonModel::local(devices).map_err(wrong)?)))
    }

    /// The model, for evaluators.
    pub fn shared(&self) -> Arc<dyn ModelWithFeatures> {
        match self {
            Self::Grace(model) => Arc::clone(model) as _,
            Self::Python(model) => Arc::clone(model) as _,
        }
    }

    /// The model, if it is one of GRACE.
    pub fn grace(&self) -> Option<&Arc<GraceModel>> {
        match self {
            Self::Grace(model) => Some(model),
            Self::Python(_) => None,
        }
    }

    /// The devices of a model in Python.
    pub fn devices(&self) -> &[Arc<Device>] {
        match self {
            Self::Grace(_) => &[],
            Self::Python(model) => model.devices(),
        }
    }

    /// What kind of model it is, in words.
    pub fn architecture(&self) -> String {
        match self {
            Self::Grace(model) => model.description().architecture.to_string(),
            Self::Python(model) => {
                format!(
                    "{} in Python, on {}",
                    model.description().adapter,
                    python_model::names(model.devices())
                )
            }
        }
    }

    /// The elements.
    pub fn elements(&self) -> &[atoms::Species] {
        match self {
            Self::Grace(model) => model.elements(),
            Self::Python(model) => model.elements(),
        }
    }

    /// Chemical symbols, in the order of the element indices.
    pub fn symbols(&self) -> Vec<String> {
        self.elements().iter().map(|element| element.symbol().to_owned()).collect()
    }

    /// The largest pair cutoff, Å.
    pub fn cutoff(&self) -> f64 {
        match self {
            Self::Grace(model) => model.cutoff(),
            Self::Python(model) => ModelWithFeatures::cutoff(&**model),
        }
    }

    /// D; 0 for a model without features, or without a projection of its invariants.
    pub fn dimension(&self) -> usize {
        match self {
            Self::Grace(model) if model.projection().is_none() => 0,
            Self::Grace(model) => model.feature_dimension(),
            Self::Python(model) => model.feature_dimension(),
        }
    }

    /// Whether a program in Python gives the features as they are graded.
    pub fn has_final_features(&self) -> bool {
        matches!(self, Self::Python(model) if model.description().features.form == AdapterFeatures::Final)
    }

    /// Number of invariants, and of the layers that they come from; `None` for a model without invariants.
    pub fn basis(&self) -> Option<(usize, usize)> {
        match self {
            Self::Grace(model) => {
                let description = model.description();
                Some((description.basis_dimension, description.architecture.layers()))
            }
            Self::Python(model) => {
                let features = &model.description().features;
                (features.form == AdapterFeatures::Raw).then_some((features.dimension, features.blocks.len()))
            }
        }
    }

    /// How the features follow from the invariants, if they do.
    pub fn projection(&self) -> Option<Projection> {
        match self {
            Self::Grace(model) => model_projection(model),
            Self::Python(model) => model.projection().map(|found| found.projection().clone()),
        }
    }

    /// The model with this projection of its invariants.
    ///
    /// # Errors
    /// A projection of other invariants, or a model without any.
    pub fn with_projection(self, projection: &Projection) -> Result<Self, String> {
        match self {
            Self::Grace(model) => {
                let model = Arc::unwrap_or_clone(model);
                let projected = with_projection(model, projection).map_err(|error| error.to_string())?;
                Ok(projected.into())
            }
            Self::Python(model) => Ok(Self::Python(Arc::new(model.projected(projection.clone())?))),
        }
    }

    /// What ties files to the model of `path`.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn content_hash(&self, path: &Path) -> Result<String, CommandError> {
        match self {
            Self::Grace(_) => file_hash::model_hash(path),
            Self::Python(model) => Ok(model.description().identity.clone()),
        }
    }

    /// Hash of the model's file, or of what the program in Python says of it.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn identity(&self, path: &Path) -> Result<String, CommandError> {
        match self {
            Self::Grace(_) => file_hash::hash(path).map_err(CommandError::input),
            Self::Python(model) => Ok(model.description().identity.clone()),
        }
    }
}
