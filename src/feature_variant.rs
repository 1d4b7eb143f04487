//! The features of a model: those that its file describes, those of an artifact, or others of the same model.

use std::path::Path;
use std::sync::Arc;

use calm::baselines::FeatureOrigin;
use calm::{Artifact, Projection, ProjectionMismatch};
use potentials::grace::FeatureForm;

use crate::artifact_checks::check_belongs_to;
use crate::exit_status::CommandError;
use crate::features::FeatureCalculator;
use crate::loaded_model::LoadedModel;

/// Which features to use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum FeatureVariant {
    /// The normalised and projected basis, with the logarithms of its norms
    Normalised,
    /// The projected basis, without normalisation and norms
    Linear,
    /// The last hidden layer of the readout, in which the energy is linear
    Hidden,
}

impl FeatureVariant {
    const ALL: [Self; 3] = [Self::Normalised, Self::Linear, Self::Hidden];

    fn name(self) -> &'static str {
        match self {
            Self::Normalised => "normalised",
            Self::Linear => "linear",
            Self::Hidden => "hidden",
        }
    }
}

/// A model with one variant of its features.
#[derive(Clone)]
pub struct FeatureModel {
    pub model: LoadedModel,
    is_hidden: bool,
}

impl FeatureModel {
    /// `None` stands for the features that the file describes.
    ///
    /// # Errors
    /// An unreadable model; one without a projection of its features, unless they are those of the hidden layer.
    pub fn load(path: &Path, variant: Option<FeatureVariant>) -> Result<Self, CommandError> {
        Self::new(path, LoadedModel::load(path)?, variant)
    }

    /// The same of a model that was loaded from `path`.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn new(
        path: &Path,
        model: LoadedModel,
        variant: Option<FeatureVariant>,
    ) -> Result<Self, CommandError> {
        let Some(variant) = variant else {
            if model.dimension() > 0 {
                return Ok(Self { model, is_hidden: false });
            }
            return Err(without_projection(path));
        };
        let LoadedModel::Grace(grace) = model else {
            return Err(CommandError::Input(format!(
                "{}: --feature-variant is for GRACE models, whose readout and basis calmwalk knows; this one runs in Python",
                path.display()
            )));
        };
        let form = match variant {
            FeatureVariant::Normalised => FeatureForm::Normalised,
            FeatureVariant::Linear => FeatureForm::Linear,
            FeatureVariant::Hidden => return Ok(Self { model: grace.into(), is_hidden: true }),
        };
        let model = grace.with_features(form).ok_or_else(|| without_projection(path))?;
        Ok(Self { model: model.into(), is_hidden: false })
    }

    /// The variant of the model of `path` whose features an artifact has: the file's own, another with the same matrix, or the hidden
    /// layer. The file's own if none fits. A model without a projection gets that of the artifact.
    ///
    /// # Errors
    /// A model of another basis.
    pub fn for_artifact(
        path: &Path,
        model: LoadedModel,
        artifact: &Projection,
    ) -> Result<Self, CommandError> {
        let hidden = model.grace().map(|grace| unchanged(grace.hidden_dimension()));
        if hidden.as_ref() == Some(artifact) {
            return Ok(Self { model, is_hidden: true });
        }
        if model.dimension() == 0 {
            let model = model
                .with_projection(artifact)
                .map_err(|error| CommandError::Input(format!("{}: {error}", path.display())))?;
            return Self::new(path, model, None);
        }
        let own = Self::new(path, model, None)?;
        let fits = |found: &Self| found.projection().is_some_and(|found| artifact.check_same(&found).is_ok());
        let Some(grace) = own.model.grace().filter(|_| !fits(&own)) else { return Ok(own) };
        let others = [FeatureForm::Normalised, FeatureForm::Linear].map(|form| grace.with_features(form));
        let mut others =
            others.into_iter().flatten().map(|model| Self { model: model.into(), is_hidden: false });
        Ok(others.find(fits).unwrap_or(own))
    }

    /// The model of a file of baselines, with their variant.
    ///
    /// # Errors
    /// Baselines of another model, or of features that the model does not have.
    pub fn for_baselines(path: &Path, baselines: &FeatureOrigin, file: &Path) -> Result<Self, CommandError> {
        let known = FeatureVariant::ALL.into_iter().find(|variant| variant.name() == baselines.variant);
        let found = Self::load(path, known)?;
        let same = baselines.check_same(&found.origin(path)?);
        same.map_err(|error| CommandError::Input(format!("{}: {error}", file.display())))?;
        Ok(found)
    }

    /// Checks that an artifact has the elements and the features of the model.
    ///
    /// # Errors
    /// The first difference.
    pub fn check_artifact(&self, artifact: &Artifact) -> Result<(), ProjectionMismatch> {
        match self.is_hidden {
            true => artifact.check_belongs_to(&self.symbols(), &unchanged(self.dimension())),
            false => check_belongs_to(artifact, &self.model),
        }
    }

    /// Computes these features on the calling thread.
    pub fn calculator(&self) -> FeatureCalculator {
        match self.model.grace().filter(|_| self.is_hidden) {
            Some(grace) => FeatureCalculator::of_hidden_layer(Arc::clone(grace)),
            None => FeatureCalculator::new(self.model.shared()),
        }
    }

    /// D
    pub fn dimension(&self) -> usize {
        match self.model.grace().filter(|_| self.is_hidden) {
            Some(grace) => grace.hidden_dimension(),
            None => self.model.dimension(),
        }
    }

    /// Whether the features are the hidden layer.
    pub fn is_hidden(&self) -> bool {
        self.is_hidden
    }

    /// The projection in an artifact of these features: theirs, or for the hidden layer, which is no projection of the basis, one that
    /// changes nothing. So have features that a program in Python gives.
    pub fn stored_projection(&self) -> Option<Projection> {
        if self.is_hidden || self.model.has_final_features() {
            return Some(unchanged(self.dimension()));
        }
        self.projection()
    }

    /// How the features follow from the basis; `None` for the hidden layer, and for features that a program in Python gives.
    pub fn projection(&self) -> Option<Projection> {
        self.model.projection().filter(|_| !self.is_hidden)
    }

    /// Chemical symbols, in the order of the element indices.
    pub fn symbols(&self) -> Vec<String> {
        self.model.symbols()
    }

    /// What ties baselines to these features.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn origin(&self, path: &Path) -> Result<FeatureOrigin, CommandError> {
        let variant = match self.projection() {
            None if self.is_hidden => FeatureVariant::Hidden.name().to_owned(),
            None => "final".to_owned(),
            Some(found) => variant(&found),
        };
        Ok(FeatureOrigin {
            model: self.model.content_hash(path)?,
            variant,
            symbols: self.symbols(),
            dimension: self.dimension(),
        })
    }
}

fn without_projection(path: &Path) -> CommandError {
    CommandError::Input(format!(
        "{}: the model has no projection of its features (uq_rp_matrix): give its artifact with --artifact, or build one with \
         calmwalk calm build",
        path.display()
    ))
}

/// The projection of features that are not projected: the identity.
pub fn unchanged(dimension: usize) -> Projection {
    let mut matrix = vec![0.0; dimension * dimension];
    matrix.iter_mut().step_by(dimension + 1).for_each(|x| *x = 1.0);
    Projection {
        matrix,
        rows: dimension,
        columns: dimension,
        feature_dimension: dimension,
        asinh: false,
        normalised: false,
        density_channels: false,
        density_scale: 1.0,
    }
}

/// The name of the features of a projection.
fn variant(projection: &Projection) -> String {
    let Projection { asinh, normalised, density_channels, density_scale, .. } = *projection;
    match (normalised, density_channels, asinh) {
        (true, true, false) if density_scale == 1.0 => FeatureVariant::Normalised.name().to_owned(),
        (false, false, false) => FeatureVariant::Linear.name().to_owned(),
        _ => format!(
            "normalised {normalised}, density channels {density_channels} × {density_scale}, asinh {asinh}"
        ),
    }
}
