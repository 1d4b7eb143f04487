//! Asks on a terminal for what the command line leaves out.

use std::io::{BufRead, Write};
use std::path::PathBuf;

use clap::ValueEnum;

use super::label_kind::InitLabelKind;
use super::own_campaign::{OwnCampaign, OwnCampaignArgs, check_readable};
use crate::exit_status::CommandError;

/// Questions and answers, a line each.
pub struct TerminalQuestions<R, W> {
    /// Where answers come from.
    pub reader: R,
    /// Where questions go.
    pub writer: W,
}

impl<R: BufRead, W: Write> TerminalQuestions<R, W> {
    /// Asks for each option that is needed and not given.
    ///
    /// # Errors
    /// The answers end too early.
    pub fn complete(&mut self, given: OwnCampaignArgs) -> Result<OwnCampaign, CommandError> {
        let (is_complete, full) = (given.missing().is_empty(), given.full);
        let model = match given.model {
            Some(model) => model,
            None => self.ask("GRACE model (kokkos.npz)", file)?,
        };
        let artifact = match given.artifact {
            None if !is_complete => self.ask(
                "its CALM artifact (gmm_artifacts.npz); empty: none, and the mixture stays as it is",
                optional,
            )?,
            artifact => artifact,
        };
        let structures = if given.structures.is_empty() { self.structures()? } else { given.structures };
        let label = match given.label {
            Some(label) => label,
            None => self.ask(&format!("labels by {}", InitLabelKind::names()), label_kind)?,
        };
        let label_source = match given.label_source {
            None if label == InitLabelKind::Potential => {
                Some(self.ask(&format!("{} for labels", label.source()), file)?)
            }
            None if !is_complete => {
                self.ask(&format!("{}; empty: fill it in later", label.source()), optional)?
            }
            source => source,
        };
        Ok(OwnCampaign { model, artifact, structures, label, label_source, full })
    }

    fn structures(&mut self) -> Result<Vec<PathBuf>, CommandError> {
        let mut all = vec![self.ask("file of seed structures (extended XYZ or POSCAR)", file)?];
        while let Some(path) = self.ask("another file of seed structures; empty: no more", optional)? {
            all.push(path);
        }
        Ok(all)
    }

    /// Asks until an answer is valid.
    fn ask<T>(
        &mut self,
        question: &str,
        parse: impl Fn(&str) -> Result<T, String>,
    ) -> Result<T, CommandError> {
        loop {
            write!(self.writer, "{question}: ")
                .and_then(|()| self.writer.flush())
                .map_err(CommandError::failed)?;
            let mut line = String::new();
            if self.reader.read_line(&mut line).map_err(CommandError::failed)? == 0 {
                return Err(CommandError::Input(format!("the input ended; expected: {question}")));
            }
            match parse(line.trim()) {
                Ok(answer) => return Ok(answer),
                Err(problem) => writeln!(self.writer, "  {problem}").map_err(CommandError::failed)?,
            }
        }
    }
}

fn file(answer: &str) -> Result<PathBuf, String> {
    optional(answer)?.ok_or_else(|| "expected the path of a file".to_owned())
}

fn optional(answer: &str) -> Result<Option<PathBuf>, String> {
    if answer.is_empty() {
        return Ok(None);
    }
    let path = PathBuf::from(answer);
    check_readable(&path)?;
    Ok(Some(path))
}

fn label_kind(answer: &str) -> Result<InitLabelKind, String> {
    <InitLabelKind as ValueEnum>::from_str(answer, true)
        .map_err(|_| format!("found '{answer}'; expected {}", InitLabelKind::names()))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn answered(given: OwnCampaignArgs, answers: &str) -> (Result<OwnCampaign, CommandError>, String) {
        let mut questions = TerminalQuestions { reader: answers.as_bytes(), writer: Vec::new() };
        let completed = questions.complete(given);
        (completed, String::from_utf8(questions.writer).unwrap())
    }

    #[test]
    fn what_is_missing_is_asked_until_it_is_valid() {
        let directory = tempfile::tempdir().unwrap();
        let file = |name: &str| {
            let path = directory.path().join(name);
            std::fs::write(&path, "").unwrap();
            path
        };
        let [model, seeds, more, teacher] = ["m.npz", "a.xyz", "b.xyz", "t.npz"].map(file);
        let [m, a, b, t] = [&model, &seeds, &more, &teacher].map(|path| path.display());
        let answers = format!("/nowhere.npz\n{m}\n\n{a}\n{b}\n\nmagic\npotential\n{t}\n");
        let (completed, shown) = answered(OwnCampaignArgs::default(), &answers);
        let found = completed.unwrap();
        assert_eq!((found.model, found.artifact, found.structures), (model.clone(), None, vec![seeds, more]));
        assert_eq!((found.label, found.label_source), (InitLabelKind::Potential, Some(teacher)));
        assert!(shown.contains("cannot read /nowhere.npz: "), "{shown}");
        assert!(shown.contains("found 'magic'; expected abinit, ase, "), "{shown}");
        assert!(shown.starts_with("GRACE model (kokkos.npz): "), "{shown}");
    }

    #[test]
    fn what_is_given_is_not_asked() {
        let given = OwnCampaignArgs {
            model: Some("m.npz".into()),
            structures: vec!["a.xyz".into()],
            label: Some(InitLabelKind::Vasp),
            ..OwnCampaignArgs::default()
        };
        let (completed, shown) = answered(given, "");
        assert_eq!((completed.unwrap().model.as_path(), shown.as_str()), (Path::new("m.npz"), ""));
    }

    #[test]
    fn answers_that_end_are_an_error() {
        let (completed, _) = answered(OwnCampaignArgs::default(), "");
        let Err(CommandError::Input(message)) = completed else { panic!("an error of the input") };
        assert_eq!(message, "the input ended; expected: GRACE model (kokkos.npz)");
    }
}
