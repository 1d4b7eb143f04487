//! `[potential.python]`: a model that its own framework evaluates.

use std::fmt;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};

use bridge::PythonSettings;
use potentials::grace::Precision;
use schemars::JsonSchema;
use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use super::defaults;
use crate::duration::Duration;

/// `[potential.python]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PythonSection {
    /// Directory of the virtual or conda environment with the model's framework, or a Python program.
    pub environment: PathBuf,
    /// Words before the Python program, for instance `["apptainer", "exec", "mace.sif"]`; `environment` is then the program inside. Relative
    /// paths in it are relative to the working directory of calmwalk. Default: none.
    #[serde(default)]
    pub launcher: Vec<String>,
    /// Adapter that evaluates the model: `gracemaker`, `mace`, `ase`, or your own as `file.py:Class` or `module:Class`.
    pub adapter: String,
    /// Settings of the adapter (see docs/python-adapters.md); paths in it are absolute. Default: none.
    #[serde(default)]
    #[schemars(with = "std::collections::BTreeMap<String, serde_json::Value>")]
    pub options: serde_json::Map<String, serde_json::Value>,
    /// Device that evaluates the model: `cpu`, `cuda`, `cuda:1`, …; or a list of devices, which share the walkers evenly.
    #[serde(default)]
    pub device: DeviceNames,
    /// Number of processor threads of the program.
    #[serde(default = "defaults::repeats")]
    pub threads: NonZeroU32,
    /// Largest number of structures that the device evaluates at once. If its memory is too small for that, it evaluates fewer.
    #[serde(default = "defaults::max_batch")]
    pub max_batch: NonZeroU32,
    /// Time limit of a call. After it, calmwalk starts the program again.
    #[serde(default = "defaults::python_timeout")]
    pub timeout: Duration,
    /// Time limit for the start, and for the first call of each size, which frameworks compile.
    #[serde(default = "defaults::compile_timeout")]
    pub compile_timeout: Duration,
    /// Directory in which frameworks keep compiled programs for the next start, and calmwalk keeps the batch size that fits the
    /// device's memory. Default: none.
    #[serde(default)]
    pub cache: Option<PathBuf>,
}

impl PythonSection {
    /// The program of each device, for this model.
    pub fn settings(&self, model: &Path, precision: Precision) -> Vec<PythonSettings> {
        let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let adapter = match PythonSettings::adapter_file(&self.adapter) {
            Some((file, class)) => format!("{}:{class}", absolute(file).display()),
            None => self.adapter.clone(),
        };
        let of_device = |device: &String| PythonSettings {
            environment: if self.launcher.is_empty() {
                absolute(&self.environment)
            } else {
                self.environment.clone()
            },
            launcher: self.launcher.clone(),
            adapter: adapter.clone(),
            model: Some(absolute(model)),
            options: self.options.clone(),
            device: device.clone(),
            precision,
            threads: self.threads,
            max_batch: self.max_batch,
            timeout: self.timeout.get(),
            compile_timeout: self.compile_timeout.get(),
            cache: self.cache.as_deref().map(absolute),
            combined_gradients: false,
        };
        self.device.names().iter().map(of_device).collect()
    }

    /// Longest time that a walker can wait for a call: for the shape that compiles, and then for its own.
    pub(super) fn longest_call(&self) -> std::time::Duration {
        self.compile_timeout.get() + self.timeout.get()
    }

    /// Resolves paths relative to the directory of the configuration.
    pub(super) fn resolve_paths(&mut self, directory: &Path) {
        // Behind a launcher, it is the program inside.
        if self.launcher.is_empty() {
            self.environment = directory.join(&self.environment);
        }
        if let Some(cache) = &mut self.cache {
            *cache = directory.join(&*cache);
        }
        if let Some((file, class)) = PythonSettings::adapter_file(&self.adapter) {
            self.adapter = format!("{}:{class}", directory.join(file).display());
        }
    }
}

/// The devices of a host: `"cuda"` or `["cuda:0", "cuda:1"]`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(untagged)]
pub enum DeviceNames {
    /// One device.
    One(String),
    /// At least one, each with a program of its own.
    Several(#[schemars(length(min = 1))] Vec<String>),
}

impl Default for DeviceNames {
    fn default() -> Self {
        Self::One("cpu".into())
    }
}

impl DeviceNames {
    /// All names.
    pub fn names(&self) -> &[String] {
        match self {
            Self::One(name) => std::slice::from_ref(name),
            Self::Several(names) => names,
        }
    }
}

impl<'de> Deserialize<'de> for DeviceNames {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct DevicesVisitor;
        impl<'de> Visitor<'de> for DevicesVisitor {
            type Value = DeviceNames;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a device such as \"cuda\", or a list with at least one")
            }

            fn visit_str<E: Error>(self, name: &str) -> Result<DeviceNames, E> {
                Ok(DeviceNames::One(name.to_owned()))
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<DeviceNames, A::Error> {
                let mut names = Vec::new();
                while let Some(name) = list.next_element()? {
                    names.push(name);
                }
                if names.is_empty() {
                    return Err(A::Error::invalid_length(0, &self));
                }
                Ok(DeviceNames::Several(names))
            }
        }
        deserializer.deserialize_any(DevicesVisitor)
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::config::{Config, demo_without_refit};

    #[test]
    fn walkers_may_wait_for_the_longest_call() {
        let timeout = |lines: &str| {
            let text = demo_without_refit().replacen("[calm]", &format!("{lines}\n[calm]"), 1);
            Config::from_draft(Path::new("c.toml"), text).unwrap().config.walker_heartbeat_timeout().as_secs()
        };
        let python = "[potential.python]\nenvironment = \"venv\"\nadapter = \"mace\"";
        assert_eq!(timeout(""), 120);
        assert_eq!(timeout(&format!("{python}\ncompile_timeout = \"5m\"\ntimeout = \"20s\"")), 320);
        assert_eq!(timeout(&format!("{python}\ncompile_timeout = \"30s\"\ntimeout = \"20s\"")), 120);
    }

    /// Which saves a gradient, except where each step needs the virial without bias.
    #[test]
    fn the_norms_of_the_bias_may_be_measured_seldom() {
        let read = |interval: u64, python: &str, more: &str| {
            let text = demo_without_refit().replacen("[calm]", &format!("{python}\n[calm]"), 1);
            let key = "# bias_norm_interval = 1 ";
            assert!(text.contains(key));
            let text = text.replacen(key, &format!("bias_norm_interval = {interval}\n{more}\n#"), 1);
            let text =
                if more.is_empty() { text } else { text.replacen("volume_ramp =", "# volume_ramp =", 1) };
            Config::from_draft(Path::new("c.toml"), text)
                .map(|loaded| loaded.config)
                .map_err(|error| error.to_string())
        };
        let python = "[potential.python]\nenvironment = \"venv\"\nadapter = \"mace\"";
        let barostat = "barostat = { pressure = 1.0 }";
        for (interval, combined) in [(1, false), (5, true)] {
            let config = read(interval, python, "").unwrap();
            assert_eq!(config.walk.bias_norm_interval.get(), interval);
            assert!(config.python_settings().iter().all(|one| one.combined_gradients == combined));
        }
        assert!(read(1, "", "").is_ok() && read(1, python, barostat).is_ok());
        let error = read(5, "", "").unwrap_err();
        assert!(error.contains("walk.bias_norm_interval") && error.contains("[potential.python]"), "{error}");
        let error = read(11, python, "").unwrap_err();
        assert!(error.contains("at most walk.bias_averaging_steps"), "{error}");
        let error = read(5, python, barostat).unwrap_err();
        assert!(error.contains("walk.bias_norm_interval") && error.contains("walk.barostat"), "{error}");
        let group = |cell: &str| format!("{python}\n[[walks]]\nname = \"a\"\n{cell}\n");
        let error = read(5, &group("pressures = [1.0]"), "").unwrap_err();
        assert!(error.contains("walk.bias_norm_interval") && error.contains("walk.barostat"), "{error}");
        assert!(read(5, &group("volume_ramps = [{ from = 1.0, to = 1.1 }]"), "").is_ok());
    }

    #[test]
    fn a_program_behind_a_launcher_is_no_path() {
        let environment = |launcher: &str| {
            let text = format!("environment = \"python3\"\nadapter = \"mace\"\n{launcher}");
            let mut section: PythonSection = toml::from_str(&text).unwrap();
            section.resolve_paths(Path::new("/campaign"));
            let settings = section.settings(Path::new("model"), Precision::default());
            settings[0].environment.display().to_string()
        };
        assert_eq!(environment(""), "/campaign/python3");
        assert_eq!(environment("launcher = [\"apptainer\", \"exec\", \"mace.sif\"]"), "python3");
    }

    #[test]
    fn a_device_is_a_text_or_a_list() {
        let read = |text: &str| serde_json::from_str::<DeviceNames>(text);
        for (text, names) in
            [("\"cuda\"", vec!["cuda"]), ("[\"cuda:0\",\"cuda:1\"]", vec!["cuda:0", "cuda:1"])]
        {
            let found = read(text).unwrap();
            assert_eq!(found.names(), names);
            assert_eq!(serde_json::to_string(&found).unwrap(), text);
        }
        for wrong in ["[]", "1", "[1]"] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
    }
}
