//! The files that `[refit]` names.

use super::loader::Loader;
use crate::config::ConfigError;

impl Loader<'_> {
    /// Keys and hashes of the replay files. Test sets must be readable too, but their contents may change.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn refit_files(&self) -> Result<Vec<(String, String)>, ConfigError> {
        let Some(refit) = &self.config.refit else { return Ok(Vec::new()) };
        let replay = refit.replay.iter().enumerate();
        let hashes =
            replay.map(|(number, file)| self.hash(&format!("refit.replay[{number}]"), file)).collect();
        for (number, set) in refit.test_sets.iter().enumerate() {
            self.hash(&format!("refit.test_sets[{number}].file"), &set.file)?;
        }
        hashes
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use super::*;
    use crate::campaign::LoadedCampaign;
    use crate::config::{compare, demo_without_refit};

    /// The demo without training frames, and with these lines behind it.
    fn load(directory: &Path, lines: &str) -> Result<LoadedCampaign, ConfigError> {
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
        let demo = demo_without_refit().replace("\"data/", &format!("\"{}/data/", configs.display()));
        let demo = demo.replacen("\ntraining_frames = ", "\n# training_frames = ", 1);
        let path = directory.join("c.toml");
        fs::write(&path, format!("{demo}\n{lines}")).unwrap();
        LoadedCampaign::load(&path)
    }

    #[test]
    fn a_campaign_depends_on_the_contents_of_replay_files_alone() {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        for (name, text) in [("a", "1"), ("b", "1"), ("c", "2"), ("t", "3")] {
            fs::write(here.join(name), text).unwrap();
        }
        let with = |replay: &str, sets: &str| {
            load(here, &format!("[refit]\nreplay = [{replay}]\ntest_sets = [{sets}]\n")).unwrap()
        };
        let first = with("\"a\"", "");
        let resolved = first.resolved();
        assert_eq!(resolved["files"]["refit.replay[0]"].as_str().map(str::len), Some(64));
        assert!(resolved["refit"]["replay"].is_null());
        let moved = with("\"b\"", "");
        assert_eq!((moved.id(), moved.resolved()), (first.id(), resolved.clone()));
        for replay in ["\"c\"", "\"a\", \"c\""] {
            let other = with(replay, "");
            assert_ne!(other.id(), first.id());
            assert_eq!(compare(&resolved, &other.resolved()).unwrap_err().key(), "refit.replay");
        }
        let displayed = with("\"a\"", "{ name = \"t\", file = \"t\" }");
        assert_eq!(displayed.id(), first.id());
        assert_eq!(compare(&resolved, &displayed.resolved()).unwrap().len(), 1);
        // Without a refit, nothing of it is recorded.
        let without = load(here, "").unwrap();
        assert_eq!(without.resolved().get("refit"), None);
        assert_ne!(without.id(), first.id());
    }

    #[test]
    fn files_that_do_not_exist_are_named_with_their_lines() {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        fs::write(here.join("a"), "1").unwrap();
        for (key, lines) in [
            ("refit.replay[1]", "[refit]\nreplay = [\"a\",\n\"missing\"]\n"),
            (
                "refit.test_sets[0].file",
                "[refit]\nreplay = [\"a\"]\n[[refit.test_sets]]\nname = \"t\"\nfile = \"missing\"\n",
            ),
        ] {
            let message = load(here, lines).err().unwrap().to_string();
            let text = fs::read_to_string(here.join("c.toml")).unwrap();
            let line = 1 + text.lines().position(|line| line.contains("\"missing\"")).unwrap();
            let expected = format!("c.toml:{line}: {key}: cannot read {}: ", here.join("missing").display());
            assert!(message.contains(&expected), "{message}\nexpected {expected}");
        }
    }
}
