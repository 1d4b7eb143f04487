//! Processor, shared memory and limits of this machine.

use std::path::Path;

use potentials::grace::Instructions;
use rustix::fs::Access;
use rustix::process::{Resource, getrlimit};

use super::check::MachineCheck;
use crate::wording::disk::megabytes;
use crate::{build_info, runtime};

const SHARED_MEMORY: &str = "/dev/shm";
/// What a small campaign takes; containers have no more by default, bytes.
const LITTLE_SHARED_MEMORY: u64 = 64 << 20;
/// File descriptors of the orchestrator: for each walker, and for everything else.
const FILES: (u64, u64) = (16, 256);
/// Processes and threads: for each walker, and for everything else.
const TASKS: (u64, u64) = (16, 64);

/// The processor, and the instruction sets that the engine uses on it.
pub fn processor() -> MachineCheck {
    const NEEDED_FOR: &str = "walks with native potentials, grades";
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = processor_name(&text).unwrap_or(std::env::consts::ARCH);
    let found = format!("{} × {name}: {}", runtime::cores(), build_info::instructions());
    if cfg!(target_arch = "x86_64") && Instructions::best().name() == "baseline" {
        let advice = "without AVX2 and FMA, products are emulated and walks take many times as long: use a processor from 2015 or later, or \
                      let the virtual machine pass its instructions on";
        return MachineCheck::absent("processor", found, NEEDED_FOR, advice);
    }
    MachineCheck::present("processor", found, NEEDED_FOR)
}

/// Name of the processor in the text of /proc/cpuinfo.
fn processor_name(cpuinfo: &str) -> Option<&str> {
    let (_, value) = cpuinfo.lines().find(|line| line.starts_with("model name"))?.split_once(':')?;
    Some(value.trim())
}

/// Shared memory; `needed` is what the campaign takes, bytes.
pub fn shared_memory(needed: Option<u64>) -> MachineCheck {
    const NAME: &str = "shared memory";
    const NEEDED_FOR: &str = "run with walkers in processes of their own, agents (not run --in-process)";
    let writable = rustix::fs::access(SHARED_MEMORY, Access::READ_OK | Access::WRITE_OK | Access::EXEC_OK);
    let disk = writable.and_then(|()| rustix::fs::statvfs(SHARED_MEMORY));
    let required = needed.is_some();
    let disk = match disk {
        Ok(disk) => disk,
        Err(error) => {
            let advice =
                "mount a tmpfs at /dev/shm that this user may write to, or use calmwalk run --in-process";
            let found = format!("{SHARED_MEMORY}: {error}");
            return MachineCheck::absent(NAME, found, NEEDED_FOR, advice).required_if(required);
        }
    };
    let [size, free] = [disk.f_blocks, disk.f_bavail].map(|blocks| blocks.saturating_mul(disk.f_frsize));
    let mounts = std::fs::read_to_string("/proc/self/mounts").unwrap_or_default();
    let kind = mount_type(&mounts, SHARED_MEMORY).unwrap_or("not a mount of its own");
    let found = format!("{SHARED_MEMORY}, {kind}, {}, {} free", megabytes(size), megabytes(free));
    let wanted = needed.unwrap_or(LITTLE_SHARED_MEMORY);
    let check = if free >= wanted {
        MachineCheck::present(NAME, found, NEEDED_FOR)
    } else {
        let advice = format!(
            "{} are needed: enlarge /dev/shm (in a container --shm-size), use fewer walkers, or run --in-process; calmwalk clean \
             removes what dead campaigns left",
            megabytes(wanted)
        );
        MachineCheck::absent(NAME, found, NEEDED_FOR, advice)
    };
    check.required_if(required)
}

/// Type of the file system that is mounted at `point`, from the text of /proc/self/mounts (proc(5)); of several, the last one
/// is visible.
fn mount_type<'a>(mounts: &'a str, point: &str) -> Option<&'a str> {
    mounts.lines().rev().find_map(|line| {
        let mut fields = line.split(' ').skip(1);
        (fields.next()? == point).then(|| fields.next()).flatten()
    })
}

/// The limit of open files for `walkers` walkers. The program raises the soft limit itself.
pub fn open_files(walkers: u64) -> MachineCheck {
    let limit = getrlimit(Resource::Nofile).maximum;
    let advice = "raise the hard limit: ulimit -Hn, LimitNOFILE= of systemd, /etc/security/limits.conf";
    limit_check("open files", limit, FILES, walkers, advice)
}

/// The limit of processes and threads of this user for `walkers` walkers.
pub fn processes(walkers: u64) -> MachineCheck {
    let limit = getrlimit(Resource::Nproc).current;
    let advice = "raise the limit: ulimit -u, TasksMax= of systemd, /etc/security/limits.conf";
    limit_check("processes", limit, TASKS, walkers, advice)
}

/// A limit (`None`: unlimited) against what each walker and everything else take.
fn limit_check(
    name: &'static str,
    limit: Option<u64>,
    (of_walker, of_others): (u64, u64),
    walkers: u64,
    advice: &str,
) -> MachineCheck {
    const NEEDED_FOR: &str = "walkers, labellers, agents, the dashboard";
    let needed = of_walker.saturating_mul(walkers).saturating_add(of_others);
    let found = limit.map_or("unlimited".to_owned(), |limit| format!("at most {limit}"));
    if limit.is_none_or(|limit| limit >= needed) {
        return MachineCheck::present(name, found, NEEDED_FOR).required_if(true);
    }
    let advice = format!("{walkers} walkers need about {needed}: {advice}");
    MachineCheck::absent(name, found, NEEDED_FOR, advice).required_if(true)
}

/// Whether a directory of this name exists, or its nearest parent that does.
pub fn nearest_existing(directory: &Path) -> &Path {
    let parent = directory.ancestors().find(|parent| parent.is_dir());
    parent.filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_processor_is_named_as_the_kernel_names_it() {
        let text =
            "processor\t: 0\nvendor_id\t: X\nmodel name\t: Some Processor: 9 @ 2 GHz\nmodel name\t: other\n";
        assert_eq!(processor_name(text), Some("Some Processor: 9 @ 2 GHz"));
        assert_eq!(processor_name(""), None);
    }

    #[test]
    fn the_last_mount_at_a_point_counts() {
        let text =
            "proc /proc proc rw 0 0\nnone /dev/shm tmpfs rw,size=64m 0 0\n/dev/sda /dev/shm ext4 rw 0 0\n";
        assert_eq!(mount_type(text, "/dev/shm"), Some("ext4"));
        assert_eq!(mount_type(text, "/proc"), Some("proc"));
        assert_eq!(mount_type(text, "/dev"), None);
        assert_eq!(mount_type("short", "/dev"), None);
    }

    #[test]
    fn limits_grow_with_the_number_of_walkers() {
        let check = |limit, walkers| limit_check("open files", limit, (16, 256), walkers, "raise it");
        assert!(!check(Some(1024), 48).is_missing());
        assert!(check(Some(1024), 49).is_missing());
        assert!(!check(None, u64::MAX).is_missing());
    }

    #[test]
    fn a_directory_that_does_not_exist_yet_is_judged_by_its_parent() {
        let here = tempfile::tempdir().unwrap();
        assert_eq!(nearest_existing(&here.path().join("a/b")), here.path());
        assert_eq!(nearest_existing(Path::new("no-such-directory-here/a")), Path::new("."));
    }

    #[test]
    fn more_shared_memory_than_there_is_is_missing() {
        assert!(shared_memory(Some(u64::MAX)).is_missing());
        assert!(!shared_memory(None).is_missing());
    }
}
