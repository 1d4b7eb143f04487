//! Whether Slurm accepts no further job for now, by what `sbatch` prints.

use std::io;
use std::process::{Output, Stdio};

use tokio::io::{AsyncBufReadExt, AsyncReadExt, BufReader};
use tokio::process::Command;

/// `sbatch` prints this when slurmctld has as many jobs as it may (`MaxJobCount`), and then tries for minutes.
const WAITS: &str = "sleeping and retrying";

/// Precedes each line of `sbatch`.
const PREFIX: &str = "sbatch: error: ";

/// Runs `sbatch` and returns its output. Kills it when it starts to wait for a place in the queue: its message would come
/// after minutes, and a caller who gave up meanwhile would not know whether there is a job. It submits nothing while it
/// sleeps.
pub async fn submission(command: &mut Command) -> io::Result<Output> {
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
    let (mut stdout, mut stderr) = (Vec::new(), Vec::new());
    if let Some(pipe) = child.stderr.take() {
        let mut lines = BufReader::new(pipe);
        let mut last = 0;
        while lines.read_until(b'\n', &mut stderr).await? > 0 {
            if String::from_utf8_lossy(&stderr[last..]).contains(WAITS) {
                child.kill().await?;
                break;
            }
            last = stderr.len();
        }
    }
    if let Some(mut pipe) = child.stdout.take() {
        pipe.read_to_end(&mut stdout).await?;
    }
    Ok(Output { status: child.wait().await?, stdout, stderr })
}

/// Why Slurm accepts no further job for now, by the standard error of `sbatch`; `None` if it refuses this job.
pub fn reason(stderr: &str) -> Option<String> {
    let lines = || stderr.lines().map(|line| line.trim().trim_start_matches(PREFIX));
    let full = lines().find(|line| line.contains(WAITS) || line.contains("Resource temporarily unavailable"));
    // Slurm names the limit in a line of its own: AssocMaxSubmitJobLimit, QOSMaxSubmitJobPerUserLimit, MaxSubmitJobsPerUser …
    let is_limit = |line: &&str| !line.contains(' ') && (line.contains("Limit") || line.contains("Max"));
    let policy = || lines().find(|line| line.contains("Job violates accounting/QOS policy"));
    let limit = match lines().find(is_limit) {
        Some(limit) => Some(limit).filter(|limit| limit.contains("SubmitJob")),
        None => policy(),
    };
    full.or(limit).map(|reason| reason.trim_end_matches(", sleeping and retrying").to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    const POLICY: &str = "sbatch: error: Batch job submission failed: Job violates accounting/QOS policy (job submit limit, user's \
                          size and/or time limits)";

    #[test]
    fn a_full_queue_is_told_from_a_refused_job() {
        for (stderr, expected) in [
            (
                "sbatch: error: Slurm temporarily unable to accept job, sleeping and retrying".to_owned(),
                Some("Slurm temporarily unable to accept job"),
            ),
            (
                "sbatch: error: Batch job submission failed: Resource temporarily unavailable".to_owned(),
                Some("Batch job submission failed: Resource temporarily unavailable"),
            ),
            (format!("sbatch: error: AssocMaxSubmitJobLimit\n{POLICY}"), Some("AssocMaxSubmitJobLimit")),
            (format!("sbatch: error: AssocGrpSubmitJobsLimit\n{POLICY}"), Some("AssocGrpSubmitJobsLimit")),
            (
                format!("sbatch: error: QOSMaxSubmitJobPerUserLimit\n{POLICY}"),
                Some("QOSMaxSubmitJobPerUserLimit"),
            ),
            (POLICY.to_owned(), Some(POLICY.trim_start_matches(PREFIX))),
            (format!("sbatch: error: QOSMaxWallDurationPerJobLimit\n{POLICY}"), None),
            (format!("sbatch: error: AssocMaxCpuPerJobLimit\n{POLICY}"), None),
            ("sbatch: error: Batch job submission failed: Invalid partition name specified".to_owned(), None),
            (
                "sbatch: error: Batch job submission failed: Requested node configuration is not available"
                    .to_owned(),
                None,
            ),
        ] {
            assert_eq!(reason(&stderr).as_deref(), expected, "{stderr}");
        }
    }

    #[tokio::test]
    async fn a_command_that_waits_is_ended() {
        let mut waiting = Command::new("sh");
        waiting.args(["-c", "echo 'sbatch: error: full, sleeping and retrying' >&2; exec sleep 1000"]);
        let output = submission(&mut waiting).await.unwrap();
        assert!(!output.status.success());
        assert_eq!(reason(&String::from_utf8_lossy(&output.stderr)).as_deref(), Some("full"));
        let mut accepted = Command::new("sh");
        accepted.args(["-c", "echo 'sbatch: warning: no limit' >&2; echo 12"]);
        let output = submission(&mut accepted).await.unwrap();
        assert!(output.status.success());
        assert_eq!((&*output.stdout, &*output.stderr), (&b"12\n"[..], &b"sbatch: warning: no limit\n"[..]));
    }
}
