//! Templates of the job scripts, and how they are filled.

use std::fs;
use std::io::Write;
use std::path::Path;

use crate::atomic_file::{AtomicFile, cannot_write};
use crate::exit_status::CommandError;

/// The built-in templates, from `configs/slurm`.
const TEMPLATES: [(&str, &str); 4] = [
    (ORCHESTRATOR, include_str!("../../../configs/slurm/orchestrator.sbatch")),
    (AGENT, include_str!("../../../configs/slurm/agent.sbatch")),
    (LABELLER, include_str!("../../../configs/slurm/labeller.sbatch")),
    (COMMON, include_str!("../../../configs/slurm/job.sh")),
];
pub const ORCHESTRATOR: &str = "orchestrator.sbatch";
pub const AGENT: &str = "agent.sbatch";
pub const LABELLER: &str = "labeller.sbatch";
/// Shell functions that the other scripts source.
pub const COMMON: &str = "job.sh";

/// Placeholders of a template with their values.
pub type TemplateValues<'a> = [(&'a str, String)];

/// The template of this name: from the site's directory if given, else the built-in one.
pub fn template(site: Option<&Path>, name: &str) -> Result<String, CommandError> {
    match site {
        Some(directory) => {
            let path = directory.join(name);
            let failed = |error| {
                CommandError::Input(format!(
                    "cannot read {}: {error}; --template needs a directory with the four files of configs/slurm",
                    path.display()
                ))
            };
            fs::read_to_string(&path).map_err(failed)
        }
        None => {
            let found = TEMPLATES.iter().find(|(of, _)| *of == name);
            Ok(found.map(|(_, text)| (*text).to_owned()).unwrap_or_default())
        }
    }
}

/// Replaces each `{name}` in the template by its value. `${name}` belongs to the shell and is kept.
///
/// # Errors
/// A name has no value.
pub fn fill(name: &str, template: &str, values: &TemplateValues<'_>) -> Result<String, CommandError> {
    let mut text = String::with_capacity(template.len());
    let mut rest = template;
    while let Some(begin) = rest.find('{') {
        let (before, from) = rest.split_at(begin);
        text += before;
        let word = placeholder(from).filter(|_| !before.ends_with('$'));
        let Some(word) = word else {
            text.push('{');
            rest = &from[1..];
            continue;
        };
        let Some((_, value)) = values.iter().find(|(name, _)| *name == word) else {
            let line = 1 + template[..template.len() - from.len()].matches('\n').count();
            let known: Vec<_> = values.iter().map(|(name, _)| format!("{{{name}}}")).collect();
            return Err(CommandError::Input(format!(
                "{name}:{line}: unknown placeholder {{{word}}}; expected one of {}",
                known.join(", ")
            )));
        };
        text += value;
        rest = &from[word.len() + 2..];
    }
    Ok(text + rest)
}

/// The name in `{name}`, if the text starts with one.
fn placeholder(text: &str) -> Option<&str> {
    let (word, _) = text.strip_prefix('{')?.split_once('}')?;
    let plain = !word.is_empty() && word.chars().all(|c| c.is_ascii_lowercase() || c == '_');
    plain.then_some(word)
}

/// Writes a script atomically: a job may read it at this moment.
pub fn write(path: &Path, text: &str) -> Result<(), CommandError> {
    let mut file = AtomicFile::create(path)?;
    file.write_all(text.as_bytes()).map_err(|error| cannot_write(path, error))?;
    file.finish()
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    fn filled(template: &str) -> Result<String, CommandError> {
        fill("agent.sbatch", template, &[("cpus", "4".into()), ("command", "calmwalk agent".into())])
    }

    #[test]
    fn shell_expansions_are_kept() {
        for text in ["${cpus} $x {a,b} { work; } {} {Cpus}", "work() {\n}\n", "a {", "x{", "${a:-0}{", ""] {
            assert_eq!(filled(text).unwrap(), text);
        }
        assert_eq!(filled("-c {cpus}\n{command}{cpus}").unwrap(), "-c 4\ncalmwalk agent4");
    }

    #[test]
    fn unknown_placeholders_are_rejected_with_their_line() {
        let Err(CommandError::Input(message)) = filled("{cpus}\n\nx {cpu} {command}") else { panic!() };
        assert_eq!(message, "agent.sbatch:3: unknown placeholder {cpu}; expected one of {cpus}, {command}");
    }

    #[test]
    fn filled_templates_are_valid_bash() {
        for (name, template) in TEMPLATES {
            let values = ["cpus", "command", "stop", "job"].map(|name| (name, format!("/a/{name}")));
            let text = fill(name, template, &values).unwrap();
            let checked = Command::new("bash").args(["-n", "-c", &text]).output().unwrap();
            assert!(checked.status.success(), "{name}: {}", String::from_utf8_lossy(&checked.stderr));
        }
    }
}
