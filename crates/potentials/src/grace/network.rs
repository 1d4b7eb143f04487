//! The weights of a model in the precision in which it is evaluated.

use std::sync::Arc;

use super::layer::Layer;
use super::precision::Precision;
use super::projection::{FeatureMap, Projection};
use super::readout::Readout;
use super::vector::{Double, Single, Vector};

/// Everything that a pass over atoms reads of a model.
#[derive(Clone, Debug)]
pub(super) struct Network<V: Vector> {
    pub layers: Vec<Layer<V>>,
    pub readout: Readout<V>,
    /// None where the file has no feature arrays.
    pub feature_map: Option<FeatureMap<V>>,
}

impl<V: Vector> Network<V> {
    /// What an atom takes on the longest tapes, its own and one of cotangents, bytes.
    pub fn tape_bytes(&self) -> usize {
        let steps = self.layers.iter().map(|layer| &layer.steps);
        let lanes = steps.map(|steps| steps.tape_lanes + steps.cotangent_lanes).max();
        lanes.unwrap_or(0) * size_of::<V>()
    }

    pub fn projection(&self) -> Option<&Projection> {
        self.feature_map.as_ref().map(|map| &map.projection)
    }
}

/// A network in one of the precisions.
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

    pub fn projection(&self) -> Option<&Projection> {
        match self {
            Self::Double(network) => network.projection(),
            Self::Mixed(network) => network.projection(),
        }
    }

    /// Energy of an atom on which nothing depends, by element, eV.
    pub fn shifts(&self) -> &[f64] {
        match self {
            Self::Double(network) => &network.readout.shifts,
            Self::Mixed(network) => &network.readout.shifts,
        }
    }
}
