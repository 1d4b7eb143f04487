//! The weights of a model in the precision of the evaluation.

use std::sync::Arc;

use super::basis::BasisLayout;
use super::layer::Layer;
use super::precision::Precision;
use super::projection::{FeatureForm, FeatureMap, GraceProjection};
use super::readout::Readout;
use super::vector::{Double, Single, Vector};

/// The data of a model that the passes over atoms read.
#[derive(Clone, Debug)]
pub(super) struct Network<V: Vector> {
    pub layers: Vec<Layer<V>>,
    pub readout: Readout<V>,
    pub basis: BasisLayout,
    /// `None` without a projection.
    pub feature_map: Option<FeatureMap<V>>,
}

impl<V: Vector> Network<V> {
    /// Memory per atom for the longest tape and one of cotangents, bytes.
    pub fn tape_bytes(&self) -> usize {
        let steps = self.layers.iter().map(|layer| &layer.steps);
        let lanes = steps.map(|steps| steps.tape_lanes + steps.cotangent_lanes).max();
        lanes.unwrap_or(0) * size_of::<V>()
    }

    pub fn projection(&self) -> Option<&GraceProjection> {
        self.feature_map.as_ref().map(|map| &map.projection)
    }

    fn set_projection(&mut self, projection: GraceProjection) {
        self.feature_map = Some(FeatureMap::new(projection, &self.basis));
    }

    fn with_features(mut self, form: FeatureForm) -> Self {
        if let Some(map) = &mut self.feature_map {
            map.projection = map.projection.with_form(form);
        }
        self
    }
}

/// A network in either precision.
#[derive(Clone, Debug)]
pub(super) enum AnyNetwork {
    Double(Arc<Network<Double>>),
    Mixed(Arc<Network<Single>>),
}

impl AnyNetwork {
    pub fn precision(&self) -> Precision {
        match self {
            Self::Double(_) => Precision::Double,
            Self::Mixed(_) => Precision::Mixed,
        }
    }

    pub fn projection(&self) -> Option<&GraceProjection> {
        match self {
            Self::Double(network) => network.projection(),
            Self::Mixed(network) => network.projection(),
        }
    }

    /// `projection` must fit the basis.
    pub fn set_projection(&mut self, projection: GraceProjection) {
        match self {
            Self::Double(network) => Arc::make_mut(network).set_projection(projection),
            Self::Mixed(network) => Arc::make_mut(network).set_projection(projection),
        }
    }

    /// As [`super::GraceModel::density_dimension`].
    pub fn density_dimension(&self) -> usize {
        match self {
            Self::Double(network) => network.readout.density_dimension(),
            Self::Mixed(network) => network.readout.density_dimension(),
        }
    }

    /// As [`super::GraceModel::hidden_dimension`].
    pub fn hidden_dimension(&self) -> usize {
        match self {
            Self::Double(network) => network.readout.hidden_dimension(),
            Self::Mixed(network) => network.readout.hidden_dimension(),
        }
    }

    /// The same network with other features.
    pub fn with_features(self, form: FeatureForm) -> Self {
        match self {
            Self::Double(network) => {
                Self::Double(Arc::new(Arc::unwrap_or_clone(network).with_features(form)))
            }
            Self::Mixed(network) => Self::Mixed(Arc::new(Arc::unwrap_or_clone(network).with_features(form))),
        }
    }

    /// Constant energy shift of each element, eV.
    pub fn shifts(&self) -> &[f64] {
        match self {
            Self::Double(network) => &network.readout.shifts,
            Self::Mixed(network) => &network.readout.shifts,
        }
    }
}
