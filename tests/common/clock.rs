//! Runs programs with a wrong clock, using libfaketime from the package of that name.

use std::fs;
use std::path::{Path, PathBuf};

/// A clock that is set manually.
pub struct Clock {
    file: PathBuf,
}

impl Clock {
    pub fn new(directory: &Path, offset: &str) -> Self {
        let clock = Self { file: directory.join("clock") };
        clock.set(offset);
        clock
    }

    /// Sets the offset, such as `+1h`.
    pub fn set(&self, offset: &str) {
        // Readers must never see a partial file.
        let new = self.file.with_extension("new");
        fs::write(&new, format!("{offset}\n")).unwrap();
        fs::rename(new, &self.file).unwrap();
    }

    /// A command that starts others with this clock. Monotonic time is unaffected.
    pub fn starter(&self) -> Vec<String> {
        let library = "/usr/$LIB/faketime/libfaketimeMT.so.1";
        let variables = [
            format!("LD_PRELOAD={library}"),
            format!("FAKETIME_TIMESTAMP_FILE={}", self.file.display()),
            "FAKETIME_NO_CACHE=1".into(),
            "FAKETIME_DONT_FAKE_MONOTONIC=1".into(),
            "DONT_FAKE_MONOTONIC=1".into(),
        ];
        ["env".to_owned()].into_iter().chain(variables).collect()
    }
}

/// The library leaves these files of killed processes.
impl Drop for Clock {
    fn drop(&mut self) {
        for entry in fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            let Some((_, pid)) = name.rsplit_once('_').filter(|(of, _)| of.contains("faketime_")) else {
                continue;
            };
            if !Path::new("/proc").join(pid).exists() {
                let _ = fs::remove_file(entry.path());
            }
        }
    }
}
