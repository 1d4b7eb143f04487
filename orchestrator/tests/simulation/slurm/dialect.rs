//! PBS and LSF, in their own words: what their commands print, as the tables in `configs/` describe it.

use std::path::Path;
use std::rc::Rc;

use batch::{CommandOutput, CustomScheduler, JobId};
use dft::FailureClass;

/// A batch system other than Slurm.
#[derive(Clone)]
pub struct Dialect {
    pub scheduler: Rc<CustomScheduler>,
    is_lsf: bool,
}

fn well(stdout: String) -> CommandOutput {
    CommandOutput { success: true, stdout, stderr: String::new() }
}

fn badly(stderr: String) -> CommandOutput {
    CommandOutput { success: false, stdout: String::new(), stderr }
}

impl Dialect {
    /// The batch system of a seed.
    pub fn of(seed: u64) -> Self {
        let is_lsf = seed % 2 == 1;
        let name = if is_lsf { "lsf" } else { "pbs" };
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../configs/{name}.toml"));
        let text = std::fs::read_to_string(path).expect("an example");
        let table: toml::Table = text.parse().expect("TOML");
        let scheduler: CustomScheduler = table["launch"]["custom"].clone().try_into().expect("its table");
        Self { scheduler: Rc::new(scheduler), is_lsf }
    }

    /// The id of a job.
    fn id(&self, number: u64) -> String {
        if self.is_lsf { number.to_string() } else { format!("{number}.server") }
    }

    /// The number of the job with this id.
    pub fn number(&self, id: &JobId) -> u64 {
        id.as_str().trim_end_matches(".server").parse().expect("one of ours")
    }

    pub fn submitted(&self, number: u64) -> CommandOutput {
        match self.is_lsf {
            true => well(format!("Job <{number}> is submitted to default queue <normal>.\n")),
            false => well(self.id(number) + "\n"),
        }
    }

    pub fn full(&self) -> CommandOutput {
        badly(match self.is_lsf {
            true => "User <me>: Pending job threshold reached. Retrying in 60 seconds...".to_owned(),
            false => "qsub: would exceed limit on resource ncpus in queue workq".to_owned(),
        })
    }

    /// A daemon that cannot be reached, perhaps only for the answer.
    pub fn unreachable(&self) -> CommandOutput {
        badly(match self.is_lsf {
            true => "Failed in an LSF library call: LIM is down; try later".to_owned(),
            false => "Connection refused\nqstat: cannot connect to server pbs (errno=111)".to_owned(),
        })
    }

    /// The state of a job, which is given in the words of Slurm; `None` if it is forgotten.
    pub fn state(&self, number: u64, state: Option<&str>) -> CommandOutput {
        let id = self.id(number);
        match (self.is_lsf, state) {
            (true, None) => badly(format!("Job <{id}> is not found")),
            (false, None) => badly(format!("qstat: Unknown Job Id {id}")),
            (true, Some(state)) => well(match state {
                "PENDING" => "PEND\n".to_owned(),
                "RUNNING" | "COMPLETING" => "RUN\n".to_owned(),
                "COMPLETED" => "DONE\n".to_owned(),
                _ => "EXIT\n".to_owned(),
            }),
            (false, Some(state)) => {
                let letter = match state {
                    "PENDING" => 'Q',
                    "RUNNING" => 'R',
                    "COMPLETING" => 'E',
                    _ => 'F',
                };
                well(format!(
                    "Job Id: {id}\n    Job_Name = calmwalk\n    job_state = {letter}\n    queue = workq\n"
                ))
            }
        }
    }

    /// What is written into the output of a job that ends so.
    pub fn last_words(&self, class: FailureClass) -> &'static str {
        match (self.is_lsf, class) {
            (true, FailureClass::TimeLimit) => "TERM_RUNLIMIT: job killed after reaching LSF run time limit.",
            (true, FailureClass::OutOfMemory) => {
                "TERM_MEMLIMIT: job killed after reaching LSF memory usage limit."
            }
            (false, FailureClass::TimeLimit) => "=>> PBS: job killed: walltime 61 exceeded limit 60",
            (false, FailureClass::OutOfMemory) => {
                "=>> PBS: job killed: mem 2097152kb exceeded limit 1048576kb"
            }
            _ => "Terminated",
        }
    }
}
