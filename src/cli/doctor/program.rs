//! Programs on the path, and what they answer.

use std::ffi::OsStr;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Where an executable of this name is on the path.
pub fn find(name: &str) -> Option<PathBuf> {
    find_in(&std::env::var_os("PATH").unwrap_or_default(), name)
}

fn find_in(path: &OsStr, name: &str) -> Option<PathBuf> {
    std::env::split_paths(path).map(|directory| directory.join(name)).find(|file| is_executable(file))
}

fn is_executable(file: &Path) -> bool {
    file.metadata().is_ok_and(|data| data.is_file() && data.permissions().mode() & 0o111 != 0)
}

/// What a program prints on standard output, or on standard error if that is empty, without the blanks around it.
///
/// # Errors
/// Why it does not start, how it fails, or that it does not end.
pub fn ask(program: &Path, arguments: &[&str]) -> Result<String, String> {
    let mut query = Command::new(program);
    query.args(arguments);
    let (status, stdout, stderr) = dft::output_of(query).map_err(|error| error.to_string())?;
    let said = if stdout.trim().is_empty() { stderr } else { stdout };
    match status.success() {
        true => Ok(said.trim().to_owned()),
        false => Err(format!("{status}: {}", said.trim().lines().next_back().unwrap_or("it says nothing"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn programs_are_found_and_answer() {
        let sh = find("sh").unwrap();
        assert_eq!(ask(&sh, &["-c", "echo ' answer '"]), Ok("answer".into()));
        assert_eq!(ask(&sh, &["-c", "echo warning >&2"]), Ok("warning".into()));
        let failed = ask(&sh, &["-c", "echo first; echo last; exit 3"]).unwrap_err();
        assert!(failed.contains('3') && failed.ends_with(": last"), "{failed}");
        assert!(find("no-such-program-of-calmwalk").is_none());
        assert!(ask(Path::new("/no/such/program"), &[]).unwrap_err().starts_with("does not start"));
    }

    #[test]
    fn files_that_cannot_be_executed_are_passed_over() {
        let here = tempfile::tempdir().unwrap();
        std::fs::write(here.path().join("sbatch"), "text").unwrap();
        assert_eq!(find_in(here.path().as_os_str(), "sbatch"), None);
    }
}
