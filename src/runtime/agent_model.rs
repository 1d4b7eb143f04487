//! The model of an agent: its files on this host, and the device of a model in Python, which must be the orchestrator's.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bridge::{Device, DeviceError, PythonSettings};
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;
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
    /// Words before the Python program. Empty: those of the configuration.
    pub launcher: Vec<String>,
    /// Directory in which frameworks keep compiled programs.
    pub cache: Option<PathBuf>,
    /// Devices that evaluate the model. Empty: those of the configuration.
    pub devices: Vec<String>,
}

impl HostPython {
    /// Whether anything is another one.
    fn is_given(&self) -> bool {
        let Self { environment, launcher, cache, devices } = self;
        environment.is_some() || !launcher.is_empty() || cache.is_some() || !devices.is_empty()
    }

    /// How the program of each device is started on this host.
    fn settings(&self, of_campaign: &[PythonSettings]) -> Vec<PythonSettings> {
        let on = |device: &String| {
            let first = of_campaign.first().cloned();
            first.map(|settings| PythonSettings { device: device.clone(), ..settings })
        };
        let mut settings = match self.devices.as_slice() {
            [] => of_campaign.to_vec(),
            devices => devices.iter().filter_map(on).collect(),
        };
        let absolute = |path: &PathBuf| std::path::absolute(path).unwrap_or_else(|_| path.clone());
        for one in &mut settings {
            if !self.launcher.is_empty() {
                one.launcher.clone_from(&self.launcher);
            }
            if let Some(environment) = &self.environment {
                // Behind a launcher, it is the program inside.
                let is_inside = !one.launcher.is_empty();
                one.environment = if is_inside { environment.clone() } else { absolute(environment) };
            }
            if let Some(cache) = &self.cache {
                one.cache = Some(absolute(cache));
            }
        }
        settings
    }
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
    if is_on_this_host(file).await? {
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

/// Whether a regular file at the orchestrator's path has the content of the orchestrator's. A large file takes a while to read.
async fn is_on_this_host(file: &HashedFile) -> Result<bool, CommandError> {
    let file = file.clone();
    let read = move || file.path.is_file() && verify_hash(&file.path, &file.hash).is_ok();
    spawn_blocking(read).await.map_err(CommandError::failed)
}

impl AgentPythonModel {
    /// Has the program use the files of this host.
    fn use_files(&mut self) {
        for settings in &mut self.settings {
            if let Some(model) = &self.model {
                settings.model = Some(model.path.clone());
            }
            let class = PythonSettings::adapter_file(&settings.adapter).map(|(_, class)| class.to_owned());
            if let (Some(adapter), Some(class)) = (&self.adapter, class) {
                settings.adapter = format!("{}:{class}", adapter.path.display());
            }
        }
    }

    /// Checks that the model of the devices of this host is the orchestrator's.
    fn check(&self, devices: &[Arc<Device>], settings: &PythonSettings) -> Result<(), CommandError> {
        let names = settings.names();
        for device in devices {
            self.reference.check(&device.info().reference, self.is_reproducible).map_err(|why| {
                let model = settings.model.as_deref().unwrap_or(Path::new("its model")).display();
                CommandError::Input(format!(
                    "{names}: {model} is not the orchestrator's model on this host: {why}"
                ))
            })?;
        }
        match python_model::irreproducible(devices, settings.max_batch.get()) {
            Some(why) if self.is_reproducible => {
                Err(CommandError::Input(format!("{names}: the campaign is reproducible, but {why}")))
            }
            _ => Ok(()),
        }
    }
}

/// Starts the devices of a model in Python, if the model is one, and prepares them for the walkers. Cancelling `stop` ends that.
///
/// # Errors
/// A program that does not start, or a model that is not the orchestrator's.
pub async fn start_devices(
    model: &AgentModel,
    here: &HostPython,
    skin: f64,
    walkers: u32,
    stop: &CancellationToken,
) -> Result<Vec<Arc<Device>>, CommandError> {
    let AgentModel::Python(python) = model else {
        let unused = "--python-environment, --python-launcher, --python-cache and --device are for models in Python, but the campaign's is an \
                      export of GRACE";
        return if here.is_given() { Err(CommandError::input(unused)) } else { Ok(Vec::new()) };
    };
    let settings = here.settings(&python.settings);
    let (starting, same_bits, stopping) = (settings.clone(), python.is_reproducible, stop.clone());
    let devices = spawn_blocking(move || python_model::start(starting, same_bits, &stopping)).await;
    let devices = match devices.map_err(CommandError::failed)? {
        Err(DeviceError::Stopped) => return Ok(Vec::new()),
        // A busy device may be free at the next start.
        Err(error @ (DeviceError::Server(_) | DeviceError::File { .. })) => {
            return Err(CommandError::failed(error));
        }
        devices => devices.map_err(CommandError::input)?,
    };
    if let (Some(first), Some(device)) = (settings.first(), devices.first()) {
        python.check(&devices, first)?;
        let (adapter, names) = (&device.info().description().adapter, python_model::names(&devices));
        log_and_print(format_args!("python: {adapter} on {names}: the orchestrator's model"));
    }
    let same_bits = python.is_reproducible && settings.iter().any(|one| one.max_batch.get() > 1);
    python_model::warm_up(&devices, &python.largest, skin, walkers, same_bits).await?;
    Ok(devices)
}

impl AgentModel {
    /// What walkers load the model from.
    pub fn for_walkers(&self) -> WalkerModel {
        match self {
            Self::Grace(files) => WalkerModel::Grace(files.clone()),
            Self::Python(python) => WalkerModel::Python(Box::new(DeviceModel {
                description: python.reference.description.clone(),
                artifact: python.artifact.clone(),
            })),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_may_have_its_own_launcher_and_cache() {
        let mut campaign = PythonSettings::new(Path::new("/env"), "mace", None);
        campaign.cache = Some("/cache".into());
        let campaign = [campaign];
        assert_eq!(HostPython::default().settings(&campaign), campaign);
        let here = HostPython {
            environment: Some("python3".into()),
            launcher: vec!["apptainer".to_owned(), "exec".to_owned()],
            cache: Some("/scratch/cache".into()),
            devices: vec!["cuda:1".to_owned()],
        };
        let found = &here.settings(&campaign)[0];
        assert_eq!((found.environment.to_str(), found.device.as_str()), (Some("python3"), "cuda:1"));
        assert_eq!(
            (found.launcher.as_slice(), found.cache.as_deref()),
            (&here.launcher[..], here.cache.as_deref())
        );
        let plain = HostPython { launcher: Vec::new(), ..here };
        assert!(plain.settings(&campaign)[0].environment.is_absolute());
    }
}
