//! A model behind a server, as walkers see it.

use std::fmt;
use std::sync::Arc;

use atoms::Species;
use potentials::grace::Threads;
use potentials::{ModelWithFeatures, PotentialWithFeatures};
use tokio_util::sync::CancellationToken;
use wire::ipc::CallAddress;

use crate::description::{AdapterFeatures, ModelDescription, RawFeatures};
use crate::device::Device;
use crate::feature_map::RawProjection;
use crate::potential::PythonPotential;

/// How a model reaches its device.
#[derive(Clone)]
pub(crate) enum Connection {
    /// In this process.
    Local(Arc<Device>),
    /// Through shared memory.
    Shared(CallAddress, CancellationToken),
}

/// A model behind a server.
pub struct PythonModel {
    description: ModelDescription,
    elements: Vec<Species>,
    projection: Option<RawProjection>,
    pub(crate) connection: Connection,
}

impl fmt::Debug for PythonModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PythonModel").field("description", &self.description).finish_non_exhaustive()
    }
}

impl PythonModel {
    /// The model of a device of this process.
    ///
    /// # Errors
    /// What is wrong with the description.
    pub fn local(device: Arc<Device>) -> Result<Self, String> {
        let description = device.info().description.clone();
        Self::new(description, Connection::Local(device))
    }

    /// The model of a device of another process. Cancelling `stopping` ends calls that do not end.
    ///
    /// # Errors
    /// What is wrong with the description.
    pub fn shared(
        description: ModelDescription,
        address: CallAddress,
        stopping: CancellationToken,
    ) -> Result<Self, String> {
        Self::new(description, Connection::Shared(address, stopping))
    }

    fn new(description: ModelDescription, connection: Connection) -> Result<Self, String> {
        let elements = description.check()?;
        Ok(Self { description, elements, projection: None, connection })
    }

    /// The same model, whose invariants become features by this projection.
    ///
    /// # Errors
    /// A projection of other invariants, or a model without invariants.
    pub fn projected(&self, projection: calm::Projection) -> Result<Self, String> {
        let RawFeatures { form, blocks, .. } = &self.description.features;
        let projection = match form {
            AdapterFeatures::Raw => Some(RawProjection::new(projection, blocks)?),
            AdapterFeatures::Final => {
                return Err("the model's program gives features that are final".to_owned());
            }
            AdapterFeatures::None => {
                return Err("the model's program gives no features, so nothing can be graded".to_owned());
            }
        };
        Ok(Self {
            description: self.description.clone(),
            elements: self.elements.clone(),
            projection,
            connection: self.connection.clone(),
        })
    }

    /// The device, if it is one of this process.
    pub fn device(&self) -> Option<&Arc<Device>> {
        match &self.connection {
            Connection::Local(device) => Some(device),
            Connection::Shared(..) => None,
        }
    }

    /// What the server said of it.
    pub fn description(&self) -> &ModelDescription {
        &self.description
    }

    /// How the invariants become features.
    pub fn projection(&self) -> Option<&RawProjection> {
        self.projection.as_ref()
    }
}

impl ModelWithFeatures for PythonModel {
    fn elements(&self) -> &[Species] {
        &self.elements
    }

    fn cutoff(&self) -> f64 {
        self.description.cutoff()
    }

    fn pair_cutoff(&self, centre: usize, neighbour: usize) -> f64 {
        self.description.cutoffs[centre][neighbour]
    }

    /// 0 without features, or with invariants that are not projected.
    fn feature_dimension(&self) -> usize {
        match (self.description.features.form, &self.projection) {
            (AdapterFeatures::Final, _) => self.description.features.dimension,
            (AdapterFeatures::Raw, Some(projection)) => projection.dimension(),
            _ => 0,
        }
    }

    fn evaluator(self: Arc<Self>, _threads: Threads) -> Box<dyn PotentialWithFeatures> {
        Box::new(PythonPotential::new(self))
    }
}
