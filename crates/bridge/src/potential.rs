//! A model behind a server as a potential.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};
use potentials::grace::{GradeFunction, PullBack};
use potentials::{ModelWithFeatures, PotentialWithFeatures};
use wire::ipc::CallClient;

use crate::call::{self, BondGeometry, Call, Topology};
use crate::device::{CallError, Device, status};
use crate::feature_map::MappedFeatures;
use crate::model::{Connection, PythonModel};

/// One client of a device, with its work arrays.
#[derive(Debug)]
pub struct PythonPotential {
    model: Arc<PythonModel>,
    client: Option<Client>,
    topology: Option<Arc<Topology>>,
    /// Of the last forward pass.
    energy: Evaluation,
    /// As the adapter gives them.
    raw: Vec<f64>,
    mapped: MappedFeatures,
}

#[derive(Debug)]
enum Client {
    Local {
        device: Arc<Device>,
        number: u64,
    },
    /// The topology that the service has, if any.
    Shared {
        calls: Box<CallClient>,
        known: Option<Arc<Topology>>,
    },
}

impl PythonPotential {
    pub(crate) fn new(model: Arc<PythonModel>) -> Self {
        let (energy, mapped) = (Evaluation::default(), MappedFeatures::default());
        Self { model, client: None, topology: None, energy, raw: Vec::new(), mapped }
    }

    fn client(&mut self) -> Result<&mut Client, PotentialError> {
        if self.client.is_none() {
            self.client = Some(Client::connect(&self.model.connection)?);
        }
        self.client
            .as_mut()
            .ok_or_else(|| PotentialError::Unavailable("no connection to the device".to_owned()))
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
        let topology = Topology::of(&species, neighbours, self.topology.as_ref());
        self.topology = Some(Arc::clone(&topology));
        let geometry = BondGeometry::of(structure, topology);
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

impl Client {
    fn connect(connection: &Connection) -> Result<Self, PotentialError> {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        match connection {
            Connection::Local(device) => {
                let number = NEXT.fetch_add(1, Ordering::Relaxed);
                Ok(Self::Local { device: Arc::clone(device), number })
            }
            Connection::Shared(address, stopping) => {
                let calls = CallClient::connect(address, stopping.clone());
                let calls = calls.map_err(|error| PotentialError::Unavailable(error.to_string()))?;
                Ok(Self::Shared { calls: Box::new(calls), known: None })
            }
        }
    }

    fn evaluate(
        &mut self,
        geometry: BondGeometry,
        options: (bool, bool),
    ) -> Result<Vec<f64>, PotentialError> {
        let (features, pull_back_follows) = options;
        match self {
            Self::Local { device, number } => {
                device.call(*number, Call::Evaluate { geometry, features, pull_back_follows }).map_err(error)
            }
            Self::Shared { calls, known } => {
                let is_new = known.as_ref().is_none_or(|known| !Arc::ptr_eq(known, &geometry.topology));
                let length = call::evaluate_words(&geometry, is_new);
                let write = |words: &mut [u64]| call::write_evaluate(&geometry, options, is_new, words);
                let numbers = shared(calls, length, write)?;
                *known = Some(geometry.topology);
                Ok(numbers)
            }
        }
    }

    fn pull_back(&mut self, cotangent: &[f64]) -> Result<Vec<f64>, PotentialError> {
        match self {
            Self::Local { device, number } => {
                device.call(*number, Call::PullBack { cotangent: cotangent.to_vec() }).map_err(error)
            }
            Self::Shared { calls, .. } => {
                let write = |words: &mut [u64]| call::write_pull_back(cotangent, words);
                shared(calls, 1 + cotangent.len(), write)
            }
        }
    }
}

fn error(error: CallError) -> PotentialError {
    match error {
        CallError::Unavailable(message) => PotentialError::Unavailable(message),
        CallError::Failed(message) => PotentialError::Failed(message),
    }
}

/// A call through shared memory.
fn shared(
    calls: &CallClient,
    length: usize,
    write: impl FnOnce(&mut [u64]),
) -> Result<Vec<f64>, PotentialError> {
    let answer = calls.call(length, write, read_answer);
    match answer.map_err(|error| PotentialError::Unavailable(error.to_string()))? {
        Some(answer) => answer.map_err(error),
        None => Err(PotentialError::Unavailable("asked to stop during a call of the device".to_owned())),
    }
}

fn read_answer(words: &[u64]) -> Result<Vec<f64>, CallError> {
    let message = || {
        let [length, bytes @ ..] = &words[1..] else { return String::new() };
        let bytes: &[u8] = bytemuck::cast_slice(bytes);
        let length = usize::try_from(*length).unwrap_or_default().min(bytes.len());
        String::from_utf8_lossy(&bytes[..length]).into_owned()
    };
    match words.first() {
        Some(&status::OK) => Ok(bytemuck::cast_slice(&words[1..]).to_vec()),
        Some(&status::FAILED) => Err(CallError::Failed(message())),
        Some(&status::UNAVAILABLE) => Err(CallError::Unavailable(message())),
        _ => Err(CallError::Unavailable("the device sent an answer without a status".to_owned())),
    }
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
