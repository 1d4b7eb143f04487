//! Starts the programs of models in Python.

use std::path::Path;
use std::sync::Arc;

use bridge::{Device, DeviceError, PythonModel, PythonSettings};
use tokio_util::sync::CancellationToken;

use crate::config::Config;
use crate::exit_status::CommandError;
use crate::loaded_model::LoadedModel;
use crate::output::log_and_print;

/// The model of a section `[potential]` of a configuration.
///
/// # Errors
/// A wrong section, or a program that does not start.
pub fn from_configuration(path: &Path) -> Result<LoadedModel, CommandError> {
    let potential = Config::load_potential(path).map_err(CommandError::input)?;
    let Some(python) = &potential.python else {
        return LoadedModel::load(potential.model.get_ref());
    };
    let settings = python.settings(potential.model.get_ref(), potential.precision);
    let device =
        start(settings).map_err(|error| CommandError::Input(format!("{}: {error}", path.display())))?;
    let model = PythonModel::local(device).map_err(CommandError::Input)?;
    Ok(LoadedModel::Python(Arc::new(model)))
}

/// Starts the program of a model, which ends with the last who uses it.
///
/// # Errors
/// A program that does not start, or a model whose derivatives are wrong.
pub fn start(settings: PythonSettings) -> Result<Arc<Device>, DeviceError> {
    let progress = |text: &str| log_and_print(format_args!("python: {text}"));
    Device::start(settings, &CancellationToken::new(), progress).map(Arc::new)
}
