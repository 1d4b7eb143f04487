//! A model behind a server, as walkers see it, and its potential.

use std::fmt;
use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};
use potentials::grace::{GradeFunction, PullBack, Threads};
use potentials::{ModelWithFeatures, PotentialWithFeatures};
use tokio_util::sync::CancellationToken;
use wire::ipc::CallAddress;

use crate::call::{BondGeometry, Topology, Wanted};
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
    /// Of energies and features together.
    combined: PullBack,
}

impl PythonPotential {
    fn new(model: Arc<PythonModel>) -> Self {
        let (energy, mapped) = (Evaluation::default(), MappedFeatures::default());
        let combined = PullBack::default();
        Self { model, client: None, topology: None, energy, raw: Vec::new(), mapped, combined }
    }

    fn client(&mut self) -> Result<&mut Client, PotentialError> {
        let client = match self.client.take() {
            Some(client) => client,
            None => self.model.clients.take()?,
        };
        Ok(self.client.insert(client))
    }

    /// Energies, and forces, virial and features as far as they are wanted.
    fn call_evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        wanted: Wanted,
    ) -> Result<(), PotentialError> {
        let needed = self.model.cutoff();
        if neighbours.cutoff() < needed {
            return Err(PotentialError::Cutoff { list: neighbours.cutoff(), needed });
        }
        let species = self.model.element_indices(&structure.species)?;
        let topology = Topology::from_list(&species, neighbours, self.topology.as_ref());
        self.topology = Some((neighbours.build_number(), Arc::clone(&topology)));
        let geometry = BondGeometry::from_structure(structure, topology);
        let numbers = self.client()?.evaluate(geometry, wanted)?;
        let Wanted { features, forces, .. } = wanted;
        let n = structure.len();
        let width = if features { self.model.description().features.dimension } else { 0 };
        let derivatives = if forces { 3 * n + 9 } else { 0 };
        let expected = n + derivatives + n * width;
        if numbers.len() != expected {
            let found = numbers.len();
            return Err(PotentialError::Failed(format!(
                "the device sent {found} numbers, expected {expected}"
            )));
        }
        let (energies, rest) = numbers.split_at(n);
        let (derivatives, raw) = rest.split_at(derivatives);
        self.energy.atomic_energies.clear();
        self.energy.atomic_energies.extend_from_slice(energies);
        self.energy.forces.clear();
        if forces {
            let (forces, virial) = derivatives.split_at(3 * n);
            self.energy.forces.extend_from_slice(forces.as_chunks().0);
            self.energy.virial = matrix(virial);
        }
        self.raw.clear();
        self.raw.extend_from_slice(raw);
        if features && let Some(projection) = self.model.projection() {
            projection.forward(&self.raw, &mut self.mapped);
        }
        Ok(())
    }

    /// The gradient of a function with this cotangent, and of the energy if wanted.
    fn call_pull_back(
        &mut self,
        cotangent: &[f64],
        with_energy: bool,
        out: &mut PullBack,
    ) -> Result<(), PotentialError> {
        let mut of_raw = Vec::new();
        let cotangent = match self.model.projection() {
            None => cotangent,
            Some(projection) => {
                projection.backward(&self.mapped, cotangent, &mut of_raw);
                &of_raw
            }
        };
        let n = self.energy.atomic_energies.len();
        let numbers = self.client()?.pull_back(cotangent, with_energy)?;
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

    /// The cotangent of the features of the last evaluation.
    fn cotangent(&self, grade: &GradeFunction) -> Vec<f64> {
        let atoms: Vec<u32> = (0..self.energy.atomic_energies.len() as u32).collect();
        let mut cotangent = vec![0.0; self.features().len()];
        grade(&atoms, self.features(), &mut cotangent);
        cotangent
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
        self.call_evaluate(structure, neighbours, Wanted::FORCES)?;
        out.clone_from(&self.energy);
        Ok(())
    }
}

impl PotentialWithFeatures for PythonPotential {
    fn model(&self) -> &dyn ModelWithFeatures {
        &*self.model
    }

    fn forward(&mut self, structure: &Structure, neighbours: &NeighbourList) -> Result<(), PotentialError> {
        self.call_evaluate(structure, neighbours, Wanted::FEATURES)
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
            Some(cotangent) => self.call_pull_back(cotangent, false, pull_back),
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
        let Some(pull_back) = pull_back else {
            self.call_evaluate(structure, neighbours, Wanted::FEATURES)?;
            let atoms: Vec<u32> = (0..structure.len() as u32).collect();
            grade(&atoms, self.features(), &mut []);
            energy.clone_from(&self.energy);
            return Ok(());
        };
        self.call_evaluate(structure, neighbours, Wanted::ALL)?;
        let cotangent = self.cotangent(grade);
        energy.clone_from(&self.energy);
        self.call_pull_back(&cotangent, false, pull_back)
    }

    /// Evaluates without forces, which then come with the pull-back: one gradient in place of two.
    fn evaluate_combined(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        grade: &GradeFunction,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.call_evaluate(structure, neighbours, Wanted::WITHOUT_FORCES)?;
        let cotangent = self.cotangent(grade);
        let mut gradient = std::mem::take(&mut self.combined);
        let made = self.call_pull_back(&cotangent, true, &mut gradient);
        if made.is_ok() {
            out.atomic_energies.clone_from(&self.energy.atomic_energies);
            out.forces.clear();
            out.forces.extend(gradient.gradient.iter().map(|g| g.map(|x| -x)));
            out.virial = gradient.virial.map(|row| row.map(|x| -x));
        }
        self.combined = gradient;
        made
    }
}

impl Drop for PythonPotential {
    fn drop(&mut self) {
        if let Some(client) = self.client.take() {
            self.model.clients.release(client);
        }
    }
}
