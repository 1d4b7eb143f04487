//! Checks where a database may be kept. SQLite's write-ahead log needs memory shared by all its processes, so
//! directories on network file systems are refused.

use std::io;
use std::path::Path;

use rustix::fs::Access;

use crate::error::{Result, StoreError};

/// Checks that `directory` exists, is writable, is on a local disk and has a name that SQLite accepts.
pub fn check_directory(directory: &Path) -> Result<()> {
    if directory.to_str().is_none() {
        let source =
            io::Error::new(io::ErrorKind::InvalidInput, "its name is not UTF-8, which SQLite requires");
        return Err(StoreError::Directory { directory: directory.into(), source });
    }
    let denied = |source: rustix::io::Errno| StoreError::Directory {
        directory: directory.into(),
        source: source.into(),
    };
    rustix::fs::access(directory, Access::READ_OK | Access::WRITE_OK | Access::EXEC_OK).map_err(denied)?;
    match network_file_system_of(directory).map_err(denied)? {
        Some(kind) => Err(StoreError::NetworkFileSystem { directory: directory.into(), kind }),
        None => Ok(()),
    }
}

/// Free bytes in `directory` for this user.
pub fn free_space(directory: &Path) -> Result<u64> {
    let disk = rustix::fs::statvfs(directory)
        .map_err(|error| StoreError::Directory { directory: directory.into(), source: error.into() })?;
    Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
}

#[cfg(target_os = "linux")]
fn network_file_system_of(directory: &Path) -> rustix::io::Result<Option<String>> {
    // The type of this field depends on the architecture; the value has 32 bits.
    let magic = rustix::fs::statfs(directory)?.f_type as u64 as u32;
    if magic != FUSE {
        return Ok(network_file_system(magic).map(str::to_owned));
    }
    let whole = directory.canonicalize().unwrap_or_else(|_| directory.to_owned());
    let mounts = std::fs::read_to_string("/proc/self/mountinfo").unwrap_or_default();
    Ok(mount_type(&mounts, &whole).filter(|kind| is_network_fuse(kind)))
}

#[cfg(not(target_os = "linux"))]
fn network_file_system_of(_: &Path) -> rustix::io::Result<Option<String>> {
    Ok(None)
}

/// File systems in user space may be local or not; the mount table tells.
const FUSE: u32 = 0x6573_5546;

/// Name of the network file system with the statfs(2) magic number `magic`; `None` for any other.
pub fn network_file_system(magic: u32) -> Option<&'static str> {
    Some(match magic {
        0x0000_6969 => "NFS",
        0x0000_517b => "SMB",
        0xfe53_4d42 => "SMB2",
        0xff53_4d42 => "CIFS",
        0x0bd0_0bd0 => "Lustre",
        0x4750_4653 => "GPFS (Spectrum Scale)",
        0x1983_0326 => "BeeGFS",
        0x5346_414f | 0x6b41_4653 => "AFS",
        0x00c3_6400 => "Ceph",
        0x7375_7245 => "Coda",
        0x0000_564c => "NCP",
        0x0102_1997 => "9P",
        0x2003_0528 => "OrangeFS",
        0xaad7_aaea => "PanFS",
        _ => return None,
    })
}

/// Whether a type in the mount table, such as `fuse.sshfs`, is a network file system.
fn is_network_fuse(kind: &str) -> bool {
    const NETWORK: [&str; 14] = [
        "sshfs",
        "glusterfs",
        "ceph",
        "juicefs",
        "rclone",
        "s3fs",
        "davfs",
        "beegfs",
        "quobyte",
        "moosefs",
        "mfs",
        "smbnetfs",
        "curlftpfs",
        "gcsfuse",
    ];
    let kind = kind.strip_prefix("fuse.").unwrap_or(kind);
    NETWORK.iter().any(|name| kind.starts_with(name))
}

/// Type of the innermost mount that contains `path`, from the text of /proc/self/mountinfo (proc(5)).
fn mount_type(mountinfo: &str, path: &Path) -> Option<String> {
    mountinfo
        .lines()
        .filter_map(|line| {
            let (before, after) = line.split_once(" - ")?;
            let point = before.split(' ').nth(4)?.replace("\\040", " ");
            Some((point, after.split(' ').next()?))
        })
        .filter(|(point, _)| path.starts_with(point))
        // Of equal mount points the last one is visible.
        .max_by_key(|(point, _)| point.len())
        .map(|(_, kind)| kind.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn network_file_systems_are_recognized_by_their_magic_numbers() {
        for (magic, name) in [
            (0x6969, "NFS"),
            (0xff53_4d42, "CIFS"),
            (0xfe53_4d42, "SMB2"),
            (0x0bd0_0bd0, "Lustre"),
            (0x4750_4653, "GPFS (Spectrum Scale)"),
            (0x1983_0326, "BeeGFS"),
            (0x5346_414f, "AFS"),
            (0x00c3_6400, "Ceph"),
        ] {
            assert_eq!(network_file_system(magic), Some(name));
        }
        // ext4, xfs, btrfs, tmpfs, overlayfs, zfs, f2fs
        for magic in [0xef53, 0x5846_5342, 0x9123_683e, 0x0102_1994, 0x794c_7630, 0x2fc1_2fc1, 0xf2f5_2010] {
            assert_eq!(network_file_system(magic), None, "{magic:x}");
        }
    }

    #[test]
    fn the_mount_table_distinguishes_file_systems_in_user_space() {
        let table = "22 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw\n\
                     30 22 0:50 / /home/a\\040b rw shared:2 - fuse.sshfs host:/x rw\n\
                     31 22 0:51 / /mnt/usb rw - fuseblk /dev/sdb1 rw\n\
                     32 22 0:52 / /data rw - ext4 /dev/sdc rw\n\
                     33 32 0:53 / /data rw - fuse.glusterfs h:/v rw\n\
                     nonsense\n";
        let kind = |path: &str| mount_type(table, Path::new(path)).unwrap();
        assert_eq!(kind("/home/a b/campaign"), "fuse.sshfs");
        assert_eq!(kind("/home/abc"), "ext4");
        assert_eq!(kind("/mnt/usb/c"), "fuseblk");
        assert_eq!(kind("/data/c"), "fuse.glusterfs");
        assert!(is_network_fuse("fuse.sshfs") && is_network_fuse("fuse.glusterfs"));
        assert!(!is_network_fuse("fuseblk") && !is_network_fuse("fuse.fuse-overlayfs"));
    }

    #[test]
    fn a_directory_of_this_machine_is_accepted_and_a_missing_one_is_not() {
        let directory = tempfile::tempdir().unwrap();
        check_directory(directory.path()).unwrap();
        let missing = directory.path().join("missing");
        let message = check_directory(&missing).unwrap_err().to_string();
        assert!(message.contains("missing") && message.contains("must exist"), "{message}");
    }
}
