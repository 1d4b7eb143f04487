//! The files that `[refit]` names.

use std::path::PathBuf;

use monitor::refit_progress::LabelSplit;
use potentials::ModelWithFeatures;
use tokio_util::sync::CancellationToken;
use toml::Spanned;

use super::loader::Loader;
use super::seed_structures::SourcedStructure;
use crate::config::{ConfigError, Warning, location};
use crate::labelled_frames::read_without_warning;
use crate::output::count;
use crate::structure_files::StructureReadingArgs;

impl Loader<'_> {
    /// Keys and hashes of the replay files. Test sets and comparisons may change. All of them are read: a refit may come after weeks.
    ///
    /// # Errors
    /// A file that cannot be read, has no labels, or has an element that the model lacks.
    pub fn refit_files(&self, model: &dyn ModelWithFeatures) -> Result<Vec<(String, String)>, ConfigError> {
        let Some(refit) = &self.config.refit else { return Ok(Vec::new()) };
        let replay = refit.replay.iter().enumerate();
        let hashes = replay.map(|(number, file)| {
            let key = format!("refit.replay[{number}]");
            let hash = self.hash(&key, file)?;
            self.check_labels(&key, file, model)?;
            Ok(hash)
        });
        let hashes = hashes.collect::<Result<_, ConfigError>>()?;
        for (list, sets) in [("test_sets", &refit.test_sets), ("comparisons", &refit.comparisons)] {
            for (number, set) in sets.iter().enumerate() {
                let key = format!("refit.{list}[{number}].file");
                self.hash(&key, &set.file)?;
                self.check_labels(&key, &set.file, model)?;
            }
        }
        Ok(hashes)
    }

    /// Warns if `refit.held_out` holds out none of the seed structures, or all: which ones is a matter of chance.
    pub fn suspicious_held_out(&self, seeds: &[SourcedStructure]) -> Option<Warning> {
        let refit = self.config.refit.as_ref().filter(|refit| refit.held_out > 0.0)?;
        let rng_seed = self.config.campaign.rng_seed;
        let split = LabelSplit { held_out: refit.held_out, compares_controls: false, rng_seed };
        let held_out = seeds.iter().filter(|seed| split.is_held_out(&seed.plan.name)).count();
        let all = count(seeds.len() as u64, "seed structure");
        let message = if held_out == 0 {
            format!(
                "none of {all} is held out, so max_held_out_error_ratio refuses nothing; take a larger share, or another \
                 campaign.rng_seed, or 0 if that is meant"
            )
        } else if held_out == seeds.len() {
            format!(
                "all of {all} are held out, so no version is trained on labels of walks; take a smaller share, or another \
                 campaign.rng_seed"
            )
        } else {
            return None;
        };
        const KEY: &str = "refit.held_out";
        Some(Warning { at: location(self.path, self.text, KEY), key: KEY.to_owned(), message })
    }

    /// Reads the labelled structures of a file.
    fn check_labels(
        &self,
        key: &str,
        file: &Spanned<PathBuf>,
        model: &dyn ModelWithFeatures,
    ) -> Result<(), ConfigError> {
        let wrong = |message: String| self.file_error(key, file, message);
        let files = StructureReadingArgs::default().files(std::slice::from_ref(file.get_ref()));
        let frames = files.and_then(|files| read_without_warning(&files, &CancellationToken::new()));
        let ((frames, _), _) = frames.map_err(|error| wrong(error.to_string()))?.unwrap_or_default();
        if frames.is_empty() {
            return Err(wrong(format!("{}: no structures", file.get_ref().display())));
        }
        let mut faults = frames.iter().filter_map(|frame| {
            let error = model.element_indices(&frame.structure.species).err()?;
            Some(format!("{}: {error}", frame.place))
        });
        faults.next().map_or(Ok(()), |fault| Err(wrong(fault)))
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

    /// A file with one structure.
    fn write(here: &Path, name: &str, info: &str, atom: &str) {
        let columns = "species:S:1:pos:R:3:forces:R:3";
        let text =
            format!("1\nLattice=\"4 0 0 0 4 0 0 0 4\" Properties={columns} {info} pbc=\"T T T\"\n{atom}\n");
        fs::write(here.join(name).with_extension("xyz"), text).unwrap();
    }

    #[test]
    fn files_without_labels_and_with_unknown_elements_are_refused_at_the_start() {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        write(here, "a", "energy=1", "Al 0 0 0 0 0 0");
        write(here, "unlabelled", "x=1", "Al 0 0 0 0 0 0");
        write(here, "other", "energy=1", "Cu 0 0 0 0 0 0");
        let of_list = |list: &str, file: &str| {
            format!(
                "replay = [\"a.xyz\"]\nstart = \"first\"\n{list} = [{{ name = \"t\", file = \"{file}\" }}]"
            )
        };
        for (lines, expected) in [
            ("replay = [\"unlabelled.xyz\"]".to_owned(), "unlabelled.xyz:1: the structure has no energy"),
            ("replay = [\"a.xyz\", \"other.xyz\"]".to_owned(), "refit.replay[1]: "),
            (of_list("test_sets", "other.xyz"), "refit.test_sets[0].file: "),
            (of_list("comparisons", "unlabelled.xyz"), "refit.comparisons[0].file: "),
        ] {
            let message = load(here, &format!("[refit]\n{lines}\n")).err().unwrap().to_string();
            assert!(message.contains(expected), "{message}\nexpected {expected}");
        }
    }

    #[test]
    fn a_campaign_depends_on_the_contents_of_replay_files_alone() {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        for (name, energy) in [("a", 1), ("b", 1), ("c", 2), ("t", 3)] {
            write(here, name, &format!("energy={energy}"), "Al 0 0 0 0 0 0");
        }
        let with = |replay: &str, sets: &str| {
            load(here, &format!("[refit]\nreplay = [{replay}]\ntest_sets = [{sets}]\n")).unwrap()
        };
        let first = with("\"a.xyz\"", "");
        let resolved = first.resolved();
        assert_eq!(resolved["files"]["refit.replay[0]"].as_str().map(str::len), Some(64));
        assert!(resolved["refit"]["replay"].is_null());
        let moved = with("\"b.xyz\"", "");
        assert_eq!((moved.id(), moved.resolved()), (first.id(), resolved.clone()));
        for replay in ["\"c.xyz\"", "\"a.xyz\", \"c.xyz\""] {
            let other = with(replay, "");
            assert_ne!(other.id(), first.id());
            assert_eq!(compare(&resolved, &other.resolved()).unwrap_err().key(), "refit.replay");
        }
        let displayed = with("\"a.xyz\"", "{ name = \"t\", file = \"t.xyz\" }");
        assert_eq!(displayed.id(), first.id());
        assert_eq!(compare(&resolved, &displayed.resolved()).unwrap().len(), 1);
        // Without a refit, nothing of it is recorded.
        let without = load(here, "").unwrap();
        assert_eq!(without.resolved().get("refit"), None);
        assert_ne!(without.id(), first.id());
    }

    #[test]
    fn chance_that_holds_out_none_or_all_seed_structures_is_told() {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        write(here, "a", "energy=1", "Al 0 0 0 0 0 0");
        let warnings = |held_out: &str| -> Vec<String> {
            let campaign =
                load(here, &format!("[refit]\nreplay = [\"a.xyz\"]\nheld_out = {held_out}\n")).unwrap();
            let of_key = campaign.warnings.iter().filter(|warning| warning.key == "refit.held_out");
            of_key.map(ToString::to_string).collect()
        };
        for (held_out, expected) in [("1e-9", "none of "), ("0.999999", "all of ")] {
            let found = warnings(held_out);
            assert!(
                found.len() == 1 && found[0].contains(expected) && found[0].contains("c.toml:"),
                "{found:?}"
            );
        }
        assert_eq!(warnings("0.0"), [""; 0]);
        assert_eq!(warnings("0.5"), [""; 0]);
    }

    #[test]
    fn files_that_do_not_exist_are_named_with_their_lines() {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        write(here, "a", "energy=1", "Al 0 0 0 0 0 0");
        for (key, lines) in [
            ("refit.replay[1]", "[refit]\nreplay = [\"a.xyz\",\n\"missing.xyz\"]\n"),
            (
                "refit.test_sets[0].file",
                "[refit]\nreplay = [\"a.xyz\"]\n[[refit.test_sets]]\nname = \"t\"\nfile = \"missing.xyz\"\n",
            ),
        ] {
            let message = load(here, lines).err().unwrap().to_string();
            let text = fs::read_to_string(here.join("c.toml")).unwrap();
            let line = 1 + text.lines().position(|line| line.contains("\"missing.xyz\"")).unwrap();
            let expected =
                format!("c.toml:{line}: {key}: cannot read {}: ", here.join("missing.xyz").display());
            assert!(message.contains(&expected), "{message}\nexpected {expected}");
        }
    }
}
