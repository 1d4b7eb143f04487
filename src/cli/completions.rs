//! `calmwalk completions` and `calmwalk man`

use std::fs;
use std::path::PathBuf;

use clap::CommandFactory;
use clap_complete::Shell;

use super::{Arguments, CommandError, ExitStatus};
use crate::output::print;

/// Print a script with which a shell completes commands and options of calmwalk
///
/// bash: calmwalk completions bash > ~/.local/share/bash-completion/completions/calmwalk
///
/// zsh: calmwalk completions zsh > a file _calmwalk in a directory of $fpath
///
/// fish: calmwalk completions fish > ~/.config/fish/completions/calmwalk.fish
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub struct CompletionsArgs {
    /// The shell
    #[arg(value_enum)]
    shell: Shell,
}

impl CompletionsArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut Arguments::command(), "calmwalk", &mut script);
        print(|out| out.write_all(&script))?;
        Ok(ExitStatus::Done)
    }
}

/// Write manual pages, one for calmwalk and one for each command
///
/// `man -l DIR/calmwalk-run.1` shows one. Pages in a directory man1 below a directory of $MANPATH are found by name: `man calmwalk-run`.
/// They have the texts of --help.
#[derive(Debug, clap::Args)]
pub struct ManArgs {
    /// Directory for the pages; it is made if it does not exist, and existing pages are replaced
    #[arg(value_name = "DIR")]
    output: PathBuf,
}

impl ManArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let directory = &self.output;
        let failed = |error| CommandError::Failed(format!("cannot write {}: {error}", directory.display()));
        fs::create_dir_all(directory).map_err(failed)?;
        clap_mangen::generate_to(Arguments::command(), directory).map_err(failed)?;
        print(|out| writeln!(out, "wrote {}", directory.join("calmwalk.1").display()))?;
        Ok(ExitStatus::Done)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shell_gets_the_names_of_commands_and_options() {
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish, Shell::Elvish, Shell::PowerShell] {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Arguments::command(), "calmwalk", &mut script);
            let script = String::from_utf8(script).unwrap();
            for name in ["force-errors", "calibration"] {
                assert!(script.contains(name), "{shell}: {name}");
            }
        }
    }

    /// Hidden commands, which calmwalk starts itself, have no page.
    #[test]
    fn every_command_has_a_page() {
        let directory = tempfile::tempdir().unwrap();
        let output = directory.path().join("man1");
        ManArgs { output: output.clone() }.run().unwrap();
        let page = fs::read_to_string(output.join("calmwalk-force-errors.1")).unwrap();
        assert!(page.contains("calibration") && page.contains(".SH SYNOPSIS"), "{page}");
        let shown = Arguments::command();
        let shown = shown.get_subcommands().filter(|command| !command.is_hide_set());
        for command in shown {
            let page = output.join(format!("calmwalk-{}.1", command.get_name()));
            assert!(page.exists(), "{}", page.display());
        }
        assert!(!output.join("calmwalk-walker.1").exists());
    }
}
