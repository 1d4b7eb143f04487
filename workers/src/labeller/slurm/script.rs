//! The batch script of a job. It contains everything needed to submit the job again.

use std::ffi::OsString;
use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::Path;

use dft::result_file;

use super::super::calculation_runner::{self, Calculation, RunnerCommand, RunnerRequest};
use super::job::{BEGUN, CalculationJob, LOG, REQUEST, SCRIPT};

/// Slurm's time limit exceeds that of the runner, which ends the calculation in order, by this, s.
const MARGIN: f64 = 60.0;
/// Bytes per unit M of `--mem`.
const MEBIBYTE: u64 = 1 << 20;
const EXCLUDE: &str = "#SBATCH --exclude=";

/// Resources of a job.
pub(in super::super) struct JobRequirements<'a> {
    pub cores: u32,
    pub gpus: u32,
    /// Options set by the user.
    pub options: &'a [String],
    /// Nodes on which it failed.
    pub avoid: &'a [String],
}

/// Writes everything that the job of a calculation needs into its directory.
pub(in super::super) fn write(
    calculation: Calculation,
    requirements: &JobRequirements<'_>,
) -> io::Result<()> {
    let directory = calculation.directory.clone();
    fs::write(directory.join(SCRIPT), script(&calculation, requirements)?)?;
    calculation_runner::send_request(
        fs::File::create(directory.join(REQUEST))?,
        &RunnerRequest::Run(calculation),
    )
}

fn script(calculation: &Calculation, requirements: &JobRequirements<'_>) -> io::Result<String> {
    let minutes = ((calculation.time_limit + MARGIN) / 60.0).ceil();
    let mut options = vec![
        "--nodes=1".to_owned(),
        format!("--ntasks={}", requirements.cores),
        format!("--time={minutes:.0}"),
    ];
    options.extend(calculation.memory_limit.map(|bytes| format!("--mem={}M", bytes.div_ceil(MEBIBYTE))));
    options.extend((requirements.gpus > 0).then(|| format!("--gres=gpu:{}", requirements.gpus)));
    options.extend(requirements.options.iter().cloned());
    let mut script = "#!/bin/sh\n".to_owned();
    for option in options {
        let _ = writeln!(script, "#SBATCH {option}");
    }
    if !requirements.avoid.is_empty() {
        let _ = writeln!(script, "{EXCLUDE}{}", requirements.avoid.join(","));
    }
    let (directory, runner) = (shell_quoted(&calculation.directory), runner(&calculation.runner)?);
    let _ = writeln!(
        script,
        "# Once, however often it is submitted.\ncd -- {directory} && mkdir {BEGUN} || exit 0\n{runner} < {REQUEST}\n\
         # The runner must not be the process that Slurm has started.\nexit $?"
    );
    Ok(script)
}

/// The runner's command as a node can execute it.
pub(in super::super) fn runner(command: &RunnerCommand) -> io::Result<String> {
    let program = match command.program.starts_with("/proc/self") {
        true => fs::read_link(&command.program)?,
        false => command.program.clone(),
    };
    let words = [shell_quoted(&program)].into_iter().chain(command.arguments.iter().map(shell_quoted));
    Ok(words.collect::<Vec<_>>().join(" "))
}

/// Quotes a word for the shell.
fn shell_quoted(word: impl AsRef<Path>) -> String {
    format!("'{}'", word.as_ref().display().to_string().replace('\'', r"'\''"))
}

/// Permits the job to run on any node. Returns whether it excluded any before.
pub(super) fn clear_excluded_nodes(directory: &Path) -> io::Result<bool> {
    let path = directory.join(SCRIPT);
    let script = result_file::read(&path).map_err(io::Error::other)?;
    let script = String::from_utf8_lossy(&script);
    let (avoiding, others): (Vec<_>, Vec<_>) =
        script.split_inclusive('\n').partition(|line| line.starts_with(EXCLUDE));
    if !avoiding.is_empty() {
        fs::write(&path, others.concat())?;
    }
    Ok(!avoiding.is_empty())
}

/// Arguments of `sbatch`. They identify the job, whatever options the user sets.
pub(super) fn arguments(job: &CalculationJob) -> Vec<OsString> {
    let option = |name: &str, value: &Path| {
        let mut option = OsString::from(name);
        option.push(value);
        option
    };
    // sbatch replaces letters after '%' by numbers of the job.
    let log = job.directory.join(LOG).display().to_string().replace('%', "%%");
    vec![
        format!("--job-name={}", job.name).into(),
        "--dependency=singleton".into(),
        "--no-requeue".into(),
        // A late job that does nothing must not overwrite the log of the first.
        "--open-mode=append".into(),
        option("--chdir=", &job.directory),
        option("--output=", log.as_ref()),
        job.directory.join(SCRIPT).into(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_script_contains_everything_a_job_needs() {
        let home = tempfile::tempdir().unwrap();
        let options = ["--partition=long".to_owned()];
        let avoid = ["n1".to_owned(), "n2".to_owned()];
        let runner = RunnerCommand {
            program: "/opt/it's/calmwalk".into(),
            arguments: vec!["calculation-runner".to_owned()],
        };
        write(
            Calculation::example(home.path(), runner),
            &JobRequirements { cores: 4, gpus: 2, options: &options, avoid: &avoid },
        )
        .unwrap();
        let text = fs::read_to_string(home.path().join(SCRIPT)).unwrap();
        let directives: Vec<_> = text.lines().filter_map(|line| line.strip_prefix("#SBATCH ")).collect();
        let expected = [
            "--nodes=1",
            "--ntasks=4",
            "--time=61",
            "--mem=1908M",
            "--gres=gpu:2",
            "--partition=long",
            "--exclude=n1,n2",
        ];
        assert_eq!(directives, expected);
        assert!(text.contains(r"'/opt/it'\''s/calmwalk' 'calculation-runner' < order.json"), "{text}");
        let order = fs::read_to_string(home.path().join(REQUEST)).unwrap();
        assert!(order.starts_with("{\"Run\"") && order.ends_with("}\n"), "{order}");
        assert!(clear_excluded_nodes(home.path()).unwrap());
        let anywhere = fs::read_to_string(home.path().join(SCRIPT)).unwrap();
        assert_eq!(anywhere, text.replace("#SBATCH --exclude=n1,n2\n", ""));
        assert!(!clear_excluded_nodes(home.path()).unwrap());
    }
}
