//! Devices, DFT codes and batch systems.

use dft::InstalledCode;

use super::check::MachineCheck;
use super::program;

/// A batch system: its command, the arguments for its version, and what it is needed for.
const SCHEDULERS: [(&str, &[&str], &str); 3] = [
    ("sbatch", &["--version"], "launch and label.batch_system under Slurm"),
    ("qsub", &["--version"], "campaigns under PBS"),
    ("bsub", &["-V"], "campaigns under LSF"),
];

/// NVIDIA devices. Nothing needs one: the processor does the same, more slowly.
pub fn device() -> MachineCheck {
    const NAME: &str = "device";
    const NEEDED_FOR: &str = "Python potentials at the speed of a GPU";
    const QUERY: [&str; 2] = ["--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"];
    let Some(path) = program::find("nvidia-smi") else {
        let advice = "for a GPU of NVIDIA, install its driver; in a container, pass the device on (--gpus all, apptainer --nv)";
        return MachineCheck::absent(NAME, "no nvidia-smi on the path", NEEDED_FOR, advice);
    };
    match program::ask(&path, &QUERY) {
        Ok(said) if !said.is_empty() => MachineCheck::present(NAME, devices(&said), NEEDED_FOR),
        answer => {
            let found = format!("nvidia-smi: {}", answer.err().unwrap_or_else(|| "no device".into()));
            MachineCheck::absent(
                NAME,
                found,
                NEEDED_FOR,
                "pass a device on to this machine, and check its driver",
            )
        }
    }
}

/// The devices of a list with one line for each, equal ones together.
fn devices(said: &str) -> String {
    let mut found: Vec<(&str, usize)> = Vec::new();
    for line in said.lines().map(str::trim) {
        match found.iter_mut().find(|(name, _)| *name == line) {
            Some((_, count)) => *count += 1,
            None => found.push((line, 1)),
        }
    }
    found.iter().map(|(name, count)| format!("{count} × {name}")).collect::<Vec<_>>().join("; ")
}

/// The DFT codes on the path.
pub fn codes() -> Vec<MachineCheck> {
    dft::installed_codes().into_iter().map(code).collect()
}

fn code(found: InstalledCode) -> MachineCheck {
    const NEEDED_FOR: &str = "labels by this code";
    let InstalledCode { method, program, path, version } = found;
    let Some(path) = path else {
        let advice = format!(
            "install it or load its module; label.method.{method}.command may name it by another path"
        );
        return MachineCheck::absent(program, "not on the path", NEEDED_FOR, advice);
    };
    match version {
        None => MachineCheck::present(program, path.display().to_string(), NEEDED_FOR),
        Some(Ok(version)) => {
            MachineCheck::present(program, format!("{version}, {}", path.display()), NEEDED_FOR)
        }
        Some(Err(error)) => MachineCheck::absent(
            program,
            error.to_string(),
            NEEDED_FOR,
            "correct its installation, or load its module",
        ),
    }
}

/// The batch systems, by the command that submits a job.
pub fn schedulers() -> Vec<(&'static str, MachineCheck)> {
    SCHEDULERS
        .iter()
        .map(|(name, version, needed_for)| (*name, scheduler(name, version, needed_for)))
        .collect()
}

fn scheduler(name: &'static str, version: &[&str], needed_for: &'static str) -> MachineCheck {
    let Some(path) = program::find(name) else {
        let advice = "work on a host from which jobs are submitted, or load the module of the batch system";
        return MachineCheck::absent(name, "not on the path", needed_for, advice);
    };
    // Old versions of PBS do not tell theirs.
    let found = program::ask(&path, version).ok().and_then(|said| said.lines().next().map(str::to_owned));
    MachineCheck::present(name, found.unwrap_or_else(|| path.display().to_string()), needed_for)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_devices_are_counted() {
        let said =
            "NVIDIA A100, 40960 MiB, 535.1\nNVIDIA A100, 40960 MiB, 535.1\nNVIDIA T4, 15360 MiB, 535.1\n";
        assert_eq!(devices(said), "2 × NVIDIA A100, 40960 MiB, 535.1; 1 × NVIDIA T4, 15360 MiB, 535.1");
    }

    #[test]
    fn a_code_without_a_path_tells_how_to_name_it() {
        let missing = InstalledCode { method: "espresso", program: "pw.x", path: None, version: None };
        let check = code(missing).required_if(true);
        assert!(check.is_missing());
        let json = serde_json::to_value(&check).unwrap();
        assert!(json["advice"].as_str().unwrap().contains("label.method.espresso.command"), "{json}");
        let there = InstalledCode {
            method: "vasp",
            program: "vasp_std",
            path: Some("/opt/vasp_std".into()),
            version: None,
        };
        assert!(!code(there).required_if(true).is_missing());
    }

    #[test]
    fn every_scheduler_is_looked_for() {
        let names: Vec<_> =
            schedulers().into_iter().map(|(name, check)| (name, check.name().to_owned())).collect();
        assert!(names.iter().all(|(name, of_check)| name == of_check), "{names:?}");
        assert_eq!(names.len(), 3);
    }
}
