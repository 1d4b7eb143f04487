//! The model of an agent: its files on this host, and the device of a model in Python, which must be the orchestrator's.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bridge::{Device, DeviceError, PythonSettings};
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;
use wire::ipc::CallAddress;
use wire::net::{LinkError, Membership};

use crate::exit_status::CommandError;
use crate::file_hash::verify_hash;
use crate::output::log_and_print;
use crate::process_config::{AgentModel, AgentPythonModel, DeviceModel, HashedFile, ModelFiles, WalkerModel};
use crate::python_model;

/// What is another one on this host than on the orchestrator's.
#[derive(Clone, Debug, Default)]
pub struct HostPython {
    /// Environment of the model's framework.
    pub environment: Option<PathBuf>,
    /// Device that evaluates the model.
    pub device: Option<String>,
}

/// Downloads the files of the model that are not on this host. `None` if this agent lost its membership meanwhile.
///
/// # Errors
/// A connection or a directory that cannot be used.
pub async fn with_files(
    joined: &Membership,
    model: AgentModel,
    directory: &Path,
) -> Result<Option<AgentModel>, CommandError> {
    let mut model = model;
    let files: Vec<(&mut HashedFile, PathBuf)> = match &mut model {
        AgentModel::Grace(ModelFiles { export, artifact, .. }) => {
            let artifact = artifact.iter_mut().map(|file| (file, directory.join("gmm_artifacts.npz")));
            [(export, directory.join("kokkos.npz"))].into_iter().chain(artifact).collect()
        }
        AgentModel::Python(python) => {
            let AgentPythonModel { model, adapter, artifact, .. } = &mut **python;
            let places = [(model, "model"), (adapter, "adapter"), (artifact, "artifact")];
            let known = places.into_iter().filter_map(|(file, place)| Some((file.as_mut()?, place)));
            // Programs look at the names of files.
            known
                .map(|(file, place)| {
                    let copy = directory.join(place).join(file.path.file_name().unwrap_or_default());
                    (file, copy)
                })
                .collect()
        }
    };
    for (file, copy) in files {
        if !has_file(joined, file, copy).await? {
            return Ok(None);
        }
    }
    if let AgentModel::Python(python) = &mut model {
        python.use_files();
    }
    Ok(Some(model))
}

/// Makes sure that a file of the orchestrator is on this host: as it is, or as a copy, which is downloaded. Returns whether this agent
/// is still a member.
async fn has_file(joined: &Membership, file: &mut HashedFile, copy: PathBuf) -> Result<bool, CommandError> {
    if verify_hash(&file.path, &file.hash).is_ok() {
        return Ok(true);
    }
    log_and_print(format_args!(
        "{} of the orchestrator is not on this host: downloading the model …",
        file.path.display()
    ));
    let bytes = match joined.fetch_file(&file.hash).await {
        Err(LinkError::RejoinRequired(_)) => return Ok(false),
        bytes => bytes.map_err(CommandError::failed)?,
    };
    let written = copy.parent().map_or(Ok(()), fs::create_dir_all).and_then(|()| fs::write(&copy, bytes));
    written.map_err(|error| CommandError::Failed(format!("cannot write {}: {error}", copy.display())))?;
    verify_hash(&copy, &file.hash).map_err(CommandError::failed)?;
    file.path = copy;
    Ok(true)
}

impl AgentPythonModel {
    /// Has the program use the files of this host.
    fn use_files(&mut self) {
        if let Some(model) = &self.model {
            self.settings.model = Some(model.path.clone());
        }
        let class = PythonSettings::adapter_file(&self.settings.adapter).map(|(_, class)| class.to_owned());
        if let (Some(adapter), Some(class)) = (&self.adapter, class) {
            self.settings.adapter = format!("{}:{class}", adapter.path.display());
        }
    }

    /// How the program is started on this host.
    fn settings_here(&self, here: &HostPython) -> PythonSettings {
        let mut settings = self.settings.clone();
        if let Some(environment) = &here.environment {
            settings.environment.clone_from(environment);
        }
        if let Some(device) = &here.device {
            settings.device.clone_from(device);
        }
        settings
    }

    /// Checks that the model of a device of this host is the orchestrator's.
    fn check(&self, device: &Device, settings: &PythonSettings) -> Result<(), CommandError> {
        let wrong = |why: &str| {
            let model = settings.model.as_deref().unwrap_or(Path::new("its model"));
            let names = settings.names();
            CommandError::Input(format!(
                "{names}: {} is not the model of the orchestrator on this host: {why}",
                model.display()
            ))
        };
        let info = device.info();
        self.reference.check(&info.reference, self.is_reproducible).map_err(|why| wrong(&why))?;
        match python_model::irreproducible(&info.self_test, settings.max_batch.get()) {
            Some(why) if self.is_reproducible => Err(CommandError::Input(format!(
                "{}: the campaign is reproducible, but {why}",
                settings.names()
            ))),
            _ => Ok(()),
        }
    }
}

/// Starts the device of a model in Python, if the model is one, and prepares it for the walkers. Cancelling `stop` ends that.
///
/// # Errors
/// A program that does not start, or a model that is not the orchestrator's.
pub async fn start_device(
    model: &AgentModel,
    here: &HostPython,
    skin: f64,
    walkers: u32,
    stop: &CancellationToken,
) -> Result<Option<Arc<Device>>, CommandError> {
    let AgentModel::Python(python) = model else {
        let given = here.environment.is_some() || here.device.is_some();
        let unused = "--python-environment and --device are for models in Python, but the campaign's is an export of GRACE";
        return if given { Err(CommandError::input(unused)) } else { Ok(None) };
    };
    let settings = python.settings_here(here);
    let (starting, stopping) = (settings.clone(), stop.clone());
    let device = spawn_blocking(move || python_model::start(starting, &stopping)).await;
    let device = match device.map_err(CommandError::failed)? {
        Err(DeviceError::Stopped) => return Ok(None),
        device => device.map_err(CommandError::input)?,
    };
    python.check(&device, &settings)?;
    let described = device.info().description();
    log_and_print(format_args!(
        "python: {} on {}: the orchestrator's model",
        described.adapter, described.device
    ));
    python_model::warm_up(&device, python.largest.clone(), skin, walkers).await?;
    Ok(Some(device))
}

/// What walkers load the model from. `device`: the device of a model in Python, and where its calls go.
pub fn walker_model(
    model: &AgentModel,
    device: Option<(&Device, &CallAddress)>,
) -> Result<WalkerModel, CommandError> {
    match (model, device) {
        (AgentModel::Grace(files), _) => Ok(WalkerModel::Grace(files.clone())),
        (AgentModel::Python(python), Some((device, address))) => {
            Ok(WalkerModel::Python(Box::new(DeviceModel {
                description: device.info().description().clone(),
                artifact: python.artifact.clone(),
                address: address.clone(),
            })))
        }
        (AgentModel::Python(_), None) => Err(CommandError::failed("the model in Python has no device")),
    }
}
