//! Devices and structures for tests.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use atoms::{Cell, Species, Structure};
use bridge::{Device, DeviceError, PythonModel, PythonSettings};
use calm::build::random_projection;
use serde_json::{Map, Value, json};
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;

/// A radial model of aluminium and copper with two blocks of invariants.
pub fn radial_model() -> Value {
    let function = |centre: f64| json!({ "centre": centre, "width": 0.9 });
    let blocks = json!([[function(2.0), function(2.8)], [function(3.6), function(4.4)]]);
    let numbers = |first: f64| (0..8).map(|k| first + 0.013 * f64::from(k)).collect::<Vec<_>>();
    let by_element = |al: Value, cu: Value| json!({ "Al": al, "Cu": cu });
    json!({
        "elements": ["Al", "Cu"], "cutoff": 5.5, "blocks": blocks,
        "shift": by_element(json!(-1.0), json!(-2.0)),
        "linear": by_element(json!(numbers(0.1)), json!(numbers(0.15))),
        "embedding": by_element(json!(numbers(0.5)), json!(numbers(0.6))),
        "floor": by_element(json!(0.02), json!(0.03)),
    })
}

/// A directory with a model, and the settings of a device.
pub struct Fixture {
    pub directory: TempDir,
    pub settings: PythonSettings,
}

impl Fixture {
    /// With the simulated adapter and these options.
    pub fn new(options: Value) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let model = directory.path().join("radial.json");
        std::fs::write(&model, radial_model().to_string()).unwrap();
        let mut settings = PythonSettings::new(&python(), "simulated", Some(&model));
        settings.options = options.as_object().cloned().unwrap_or_else(Map::new);
        settings.timeout = Duration::from_secs(20);
        settings.compile_timeout = Duration::from_secs(20);
        Self { directory, settings }
    }

    /// Starts the device.
    pub fn device(&self) -> Result<Arc<Device>, DeviceError> {
        Device::start(self.settings.clone(), true, &CancellationToken::new(), |_| {}).map(Arc::new)
    }

    /// Its model, with projected features.
    pub fn model(device: &Arc<Device>) -> Arc<PythonModel> {
        let model = PythonModel::local(vec![Arc::clone(device)]).unwrap();
        Arc::new(model.projected(random_projection(1, 8, 5, 2)).unwrap())
    }

    /// A file by which faults are ordered.
    pub fn control(&self) -> PathBuf {
        self.directory.path().join("control")
    }
}

/// The Python of the tests.
pub fn python() -> PathBuf {
    let python = std::env::var_os("CALMWALK_PYTHON").expect("CALMWALK_PYTHON names a Python with numpy");
    Path::new(&python).to_owned()
}

/// A distorted crystal of aluminium with some copper.
pub fn crystal(repeats: usize, seed: usize) -> Structure {
    let a = 4.05;
    let [al, cu] = ["Al", "Cu"].map(|symbol| symbol.parse::<Species>().unwrap());
    let mut structure = Structure {
        species: Vec::new(),
        positions: Vec::new(),
        cell: Cell([
            [a * repeats as f64, 0.0, 0.0],
            [0.0, a * repeats as f64, 0.0],
            [0.0, 0.0, a * repeats as f64],
        ]),
        periodic: [true; 3],
    };
    let sites = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];
    for cell in 0..repeats.pow(3) {
        let corner = [cell % repeats, cell / repeats % repeats, cell / (repeats * repeats)];
        for (number, site) in sites.iter().enumerate() {
            let k = 4 * cell + number + seed;
            let shift = |axis: usize| 0.1 * ((k * (axis + 2)) as f64).sin();
            structure
                .positions
                .push(std::array::from_fn(|axis| a * (corner[axis] as f64 + site[axis]) + shift(axis)));
            structure.species.push(if k % 5 == 0 { cu } else { al });
        }
    }
    structure
}
