//! A model behind a server, as walkers see it, and its potential.

use std::fmt;
use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};
use potentials::grace::{GradeFunction, PullBack, Threads};
use potentials::{ModelWithFeatures, PotentialWithFeatures};
use tokio_util::sync::CancellationToken;
use wire::ipc::CallAddress;

use crate::call::{BondGeometry, Topology};
use crate::client::{Client, ClientPool, DeviceConnection};
use crate::description::{AdapterFeatures, ModelDescription, RawFeatures};
use crate::device::Device;
use crate::feature_map::{MappedFeatures, RawProjection};

/// A model behind a server.
pub struct PythonModel {
    description: ModelDescription,
    elements: Vec<Species>,
    projection: Option<RawProjection>,
    clients: Arc<ClientPool>,
}

impl fmt::Debug for PythonModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PythonModel").field("description", &self.description).finish_non_exhaustive()
    }
}

impl PythonModel {
    /// The model of devices of this process. Evaluators take turns with them.
    ///
    /// # Errors
    /// What is wrong with the description, or that there is no device.
    pub fn local(devices: Vec<Arc<Device>>) -> Result<Self, String> {
        let first = devices.first().ok_or("a model without a device")?;
        let description = first.info().description().clone();
        Self::new(description, DeviceConnection::Local(devices))
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
        Self::new(description, DeviceConnection::Shared(address, stopping))
    }

    fn new(description: ModelDescription, connection: DeviceConnection) -> Result<Self, String> {
        let elements = description.check()?;
        let clients = Arc::new(ClientPool::new(connection));
        Ok(Self { description, elements, projection: None, clients })
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
            clients: Arc::clone(&self.clients),
        })
    }

    /// The devices of this process.
    pub fn devices(&self) -> &[Arc<Device>] {
        self.clients.devices()
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

/// A model with a client of its device, and work arrays.
#[derive(Debug)]
pub struct PythonPotential {
    model: Arc<PythonModel>,
    client: Option<Client>,
    /// Of the last structure, and the build of its neighbour list.
    topology: Option<(u64, Arc<Topology>)>,
    /// Of the last forward pass.
    energy: Evaluation,
    /// As the adapter gives them.
    raw: Vec<f64>,
    mapped: MappedFeatures,
}

impl PythonPotential {
    fn new(model: Arc<PythonModel>) -> Self {
        let (energy, mapped) = (Evaluation::default(), MappedFeatures::default());
        Self { model, client: None, topology: None, energy, raw: Vec::new(), mapped }
    }

    fn client(&mut self) -> Result<&mut Client, PotentialError> {
        let client = match self.client.take() {
            Some(client) => client,
            None => self.model.clients.take()?,
        };
        Ok(self.client.insert(client))
    }

    /// Energies, forces, virial and, if wanted, features.
    fn call_evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        (features, pull_back_follows): (bool, bool),
    ) -> Result<(), PotentialError> {
        let needed = self.model.cutoff();
        if neighbours.cutoff() < needed {
            return Err(PotentialError::Cutoff { list: neighbours.cutoff(), needed });
        }
        let species = self.model.element_indices(&structure.species)?;
        let topology = Topology::from_list(&species, neighbours, self.topology.as_ref());
        self.topology = Some((neighbours.build_number(), Arc::clone(&topology)));
        let geometry = BondGeometry::from_structure(structure, topology);
        let numbers = self.client()?.evaluate(geometry, (features, pull_back_follows))?;
        let n = structure.len();
        let width = if features { self.model.description().features.dimension } else { 0 };
        let expected = 4 * n + 9 + n * width;
        if numbers.len() != expected {
            let found = numbers.len();
            return Err(PotentialError::Failed(format!(
                "the device sent {found} numbers, expected {expected}"
            )));
        }
        let (energies, rest) = numbers.split_at(n);
        let (forces, rest) = rest.split_at(3 * n);
        let (virial, raw) = rest.split_at(9);
        self.energy.atomic_energies.clear();
        self.energy.atomic_energies.extend_from_slice(energies);
        self.energy.forces.clear();
        self.energy.forces.extend_from_slice(forces.as_chunks().0);
        self.energy.virial = matrix(virial);
        self.raw.clear();
        self.raw.extend_from_slice(raw);
        if features && let Some(projection) = self.model.projection() {
            projection.forward(&self.raw, &mut self.mapped);
        }
        Ok(())
    }

    fn call_pull_back(&mut self, cotangent: &[f64], out: &mut PullBack) -> Result<(), PotentialError> {
        let mut of_raw = Vec::new();
        let cotangent = match self.model.projection() {
            None => cotangent,
            Some(projection) => {
                projection.backward(&self.mapped, cotangent, &mut of_raw);
                &of_raw
            }
        };
        let n = self.energy.forces.len();
        let numbers = self.client()?.pull_back(cotangent)?;
        let Some((gradient, virial)) =
            numbers.split_at_checked(3 * n).filter(|(_, virial)| virial.len() == 9)
        else {
            let (found, expected) = (numbers.len(), 3 * n + 9);
            return Err(PotentialError::Failed(format!(
                "the device sent {found} numbers, expected {expected}"
            )));
        };
        out.gradient.clear();
        out.gradient.extend_from_slice(gradient.as_chunks().0);
        out.virial = matrix(virial);
        Ok(())
    }
}

fn matrix(nine: &[f64]) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|k| nine[3 * i + k]))
}

impl Potential for PythonPotential {
    fn cutoff(&self) -> f64 {
        self.model.cutoff()
    }

    fn species(&self) -> &[Species] {
        self.model.elements()
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.call_evaluate(structure, neighbours, (false, false))?;
        out.clone_from(&self.energy);
        Ok(())
    }
}

impl PotentialWithFeatures for PythonPotential {
    fn model(&self) -> &dyn ModelWithFeatures {
        &*self.model
    }

    fn forward(&mut self, structure: &Structure, neighbours: &NeighbourList) -> Result<(), PotentialError> {
        self.call_evaluate(structure, neighbours, (true, false))
    }

    fn atomic_energies(&self) -> &[f64] {
        &self.energy.atomic_energies
    }

    fn features(&self) -> &[f64] {
        if self.model.projection().is_some() { &self.mapped.features } else { &self.raw }
    }

    fn backward(
        &mut self,
        cotangent: Option<&[f64]>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) -> Result<(), PotentialError> {
        energy.clone_from(&self.energy);
        match cotangent {
            Some(cotangent) => self.call_pull_back(cotangent, pull_back),
            None => {
                pull_back.reset(self.energy.forces.len());
                Ok(())
            }
        }
    }

    fn evaluate_graded(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        grade: &GradeFunction,
        energy: &mut Evaluation,
        pull_back: Option<&mut PullBack>,
    ) -> Result<(), PotentialError> {
        self.call_evaluate(structure, neighbours, (true, pull_back.is_some()))?;
        let atoms: Vec<u32> = (0..structure.len() as u32).collect();
        let wants_cotangent = pull_back.is_some();
        let mut cotangent = vec![0.0; if wants_cotangent { self.features().len() } else { 0 }];
        grade(&atoms, self.features(), &mut cotangent);
        energy.clone_from(&self.energy);
        match pull_back {
            Some(pull_back) => self.call_pull_back(&cotangent, pull_back),
            None => Ok(()),
        }
    }
}

impl Drop for PythonPotential {
    fn drop(&mut self) {
        if let Some(client) = self.client.take() {
            self.model.clients.release(client);
        }
    }
}
