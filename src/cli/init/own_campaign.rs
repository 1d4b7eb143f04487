//! The configuration of a user's own campaign: its options, and the files that they lead to.

use std::io::{self, BufReader, IsTerminal};
use std::path::{Component, Path, PathBuf};

use super::label_section::InitLabelKind;
use super::questions::TerminalQuestions;
use super::suggestion::SuggestedSettings;
use super::{CONFIG, SCHEMA, refuse_existing, text, write_all};
use crate::campaign::CampaignDraft;
use crate::config::FILL_IN;
use crate::exit_status::{CommandError, ExitStatus};
use crate::output::{count, log_and_warn, print};

/// The options of a campaign of one's own.
#[derive(Debug, Default, clap::Args)]
pub struct OwnCampaignArgs {
    /// GRACE model that drives the walks (kokkos.npz)
    #[arg(long, value_name = "MODEL.npz")]
    pub model: Option<PathBuf>,
    /// Its CALM artifact (gmm_artifacts.npz). Without one, the mixture of the model grades structures but is not updated
    #[arg(long, value_name = "ARTIFACT.npz")]
    pub artifact: Option<PathBuf>,
    /// Seed structures, extended XYZ or POSCAR
    #[arg(long, value_name = "FILES", num_args = 1..)]
    pub structures: Vec<PathBuf>,
    /// What makes labels
    #[arg(long, value_name = "KIND")]
    pub label: Option<InitLabelKind>,
    /// What the labels come from. potential: its file (.npz, .eam.alloy, .eam.fs, .sw), required; vasp, abinit, gpaw, cp2k,
    /// espresso: the directory of pseudopotentials; ase: the Python file with calculator(); command: the script
    #[arg(long, value_name = "PATH")]
    pub label_source: Option<PathBuf>,
    /// List every key, those with default values commented out
    #[arg(long)]
    pub full: bool,
}

/// A campaign of which all options are known.
pub struct OwnCampaign {
    /// GRACE model.
    pub model: PathBuf,
    /// CALM artifact.
    pub artifact: Option<PathBuf>,
    /// Files of seed structures.
    pub structures: Vec<PathBuf>,
    /// What makes labels.
    pub label: InitLabelKind,
    /// What the labels come from.
    pub label_source: Option<PathBuf>,
    /// Whether every key is listed.
    pub full: bool,
}

impl OwnCampaignArgs {
    /// Whether any of the options is given.
    pub fn is_given(&self) -> bool {
        let Self { model, artifact, structures, label, label_source, full } = self;
        let paths = [model, artifact, label_source];
        paths.iter().any(|path| path.is_some()) || !structures.is_empty() || label.is_some() || *full
    }

    /// The options that are needed and not given.
    pub fn missing(&self) -> Vec<&'static str> {
        let needs_source = self.label == Some(InitLabelKind::Potential) && self.label_source.is_none();
        let options = [
            ("--model", self.model.is_none()),
            ("--structures", self.structures.is_empty()),
            ("--label", self.label.is_none()),
            ("--label-source", needs_source),
        ];
        options.into_iter().filter(|(_, is_missing)| *is_missing).map(|(option, _)| option).collect()
    }

    /// Asks for what is missing, if there is a terminal.
    fn complete(self) -> Result<OwnCampaign, CommandError> {
        let missing = self.missing();
        let is_terminal = io::stdin().is_terminal() && io::stderr().is_terminal();
        if !missing.is_empty() && !is_terminal {
            return Err(CommandError::Input(format!(
                "{} missing: expected --model, --structures and --label, and with --label potential also --label-source (on \
                 a terminal, calmwalk asks for them)",
                missing.join(", ")
            )));
        }
        TerminalQuestions { reader: BufReader::new(io::stdin()), writer: io::stderr() }.complete(self)
    }
}

impl OwnCampaign {
    /// Checks that the files exist, and that another potential than the model makes labels.
    fn check(&self) -> Result<(), CommandError> {
        let options = [("--artifact", &self.artifact), ("--label-source", &self.label_source)];
        let options = options.into_iter().filter_map(|(option, path)| Some((option, path.as_ref()?)));
        let structures = self.structures.iter().map(|path| ("--structures", path));
        for (option, path) in options.chain(structures).chain([("--model", &self.model)]) {
            check_readable(path).map_err(|problem| CommandError::Input(format!("{option}: {problem}")))?;
        }
        let canonical = |path: &PathBuf| path.canonicalize().ok();
        let source = self.label_source.as_ref().and_then(canonical);
        if self.label == InitLabelKind::Potential && source == canonical(&self.model) {
            return Err(CommandError::Input(format!(
                "--label-source: {} is the model itself, so all labels would agree with it; expected another potential",
                self.model.display()
            )));
        }
        Ok(())
    }
}

/// Writes the configuration and the schema, and prints what to do next.
pub fn create(directory: &Path, options: OwnCampaignArgs) -> Result<ExitStatus, CommandError> {
    let [config, schema] = [CONFIG, SCHEMA].map(|name| directory.join(name));
    refuse_existing([config.as_path(), schema.as_path()].into_iter())?;
    let campaign = options.complete()?;
    campaign.check()?;
    let read = |settings: &SuggestedSettings| {
        let text = text::configuration(directory, &campaign, settings)?;
        let draft = CampaignDraft::read(&config, &text).map_err(|error| {
            CommandError::Input(format!(
                "nothing is written, since calmwalk validate would refuse it: {error}"
            ))
        })?;
        Ok::<_, CommandError>((text, draft))
    };
    let (_, draft) = read(&SuggestedSettings::first_guess())?;
    let (text, draft) = read(&SuggestedSettings::from_draft(&draft))?;
    draft.warnings.iter().for_each(log_and_warn);
    write_all(directory, [(CONFIG, text.as_bytes())])?;
    let (unfilled, config) = (text.matches(&format!("\"{FILL_IN}")).count(), config.display());
    print(|out| {
        writeln!(
            out,
            "created {config} for {}; next:",
            count(draft.seed_structures.len(), "seed structure")
        )?;
        if unfilled > 0 {
            writeln!(out, "  complete {} that begin with {}", count(unfilled, "value"), FILL_IN.trim())?;
        }
        writeln!(out, "  calmwalk validate {config}")?;
        writeln!(out, "  calmwalk estimate {config}")?;
        writeln!(out, "  calmwalk run {config}")
    })?;
    Ok(ExitStatus::Done)
}

/// Checks that there is a file or directory.
pub fn check_readable(path: &Path) -> Result<(), String> {
    std::fs::metadata(path).map(drop).map_err(|error| format!("cannot read {}: {error}", path.display()))
}

/// A path as a configuration in `directory` names it, in quotes: relative if it is below the directory, otherwise absolute.
pub fn path_value(directory: &Path, path: &Path) -> Result<String, CommandError> {
    let [base, path] = [directory, path].map(|path| std::path::absolute(path).map_err(CommandError::failed));
    let (base, path) = (base?, path?);
    let is_plain = |inside: &&Path| !inside.components().any(|part| part == Component::ParentDir);
    let named = path.strip_prefix(&base).ok().filter(is_plain).unwrap_or(&path);
    match named.to_str() {
        Some(text) => Ok(quoted(text)),
        None => Err(CommandError::Input(format!(
            "{}: the path is not UTF-8 text; expected one that a configuration can name",
            named.display()
        ))),
    }
}

/// A text as a value of TOML.
pub fn quoted(text: &str) -> String {
    toml::Value::from(text).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_below_the_directory_are_relative() {
        let value = |path: &str| path_value(Path::new("/a/run"), Path::new(path)).unwrap();
        assert_eq!(value("/a/run/models/m.npz"), "\"models/m.npz\"");
        assert_eq!(value("/a/run/./m.npz"), "\"m.npz\"");
        for path in ["/a/other/m.npz", "/a/run/../m.npz", "/a/runs/m.npz"] {
            assert_eq!(value(path), format!("\"{path}\""));
        }
    }
}
