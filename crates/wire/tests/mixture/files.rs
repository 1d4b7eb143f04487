//! The file: permissions, damage, lack of memory.

use std::fs::{self, OpenOptions};
use std::os::unix::fs::{FileExt, MetadataExt, PermissionsExt};
use std::path::Path;
use std::process::Command;

use tempfile::tempdir_in;
use wire::{MixtureReader, SharedMixture, SharedMixtureError};

use super::helpers::{check, first, next};

#[test]
fn the_file_is_private_and_has_the_announced_size() {
    let folder = tempdir_in("/dev/shm").unwrap();
    let path = folder.path().join("mixture");
    let shared = SharedMixture::create(&path, &first(), 4).unwrap();
    let data = fs::metadata(&path).unwrap();
    assert_eq!(data.permissions().mode() & 0o7777, 0o600);
    assert_eq!(512 * data.blocks(), SharedMixture::space_needed(&first(), 4).unwrap());
    drop(shared);
    assert!(path.exists());
}

#[test]
fn a_new_file_replaces_an_old_one_that_readers_keep() {
    let folder = tempdir_in("/dev/shm").unwrap();
    let path = folder.path().join("mixture");
    let _old = SharedMixture::create(&path, &first(), 1).unwrap();
    let mut reader = MixtureReader::open(&path, 0).unwrap();
    let _new = SharedMixture::create(&path, &next(&first()), 1).unwrap();
    check(&reader.pin(0).unwrap());
    check(&MixtureReader::open(&path, 0).unwrap().pin(1).unwrap());
}

#[test]
fn other_files_are_rejected() {
    let folder = tempdir_in("/dev/shm").unwrap();
    let path = folder.path().join("mixture");
    let refused = || MixtureReader::open(&path, 0).unwrap_err();
    assert!(matches!(refused(), SharedMixtureError::File { doing: "open", .. }));
    fs::write(&path, "short").unwrap();
    assert!(matches!(refused(), SharedMixtureError::Damaged { .. }));
    fs::write(&path, [b'x'; 9000]).unwrap();
    assert!(matches!(refused(), SharedMixtureError::Magic { found: [b'x', ..], .. }));

    let _shared = SharedMixture::create(&path, &first(), 1).unwrap();
    let file = OpenOptions::new().write(true).open(&path).unwrap();
    file.write_all_at(&2_u32.to_le_bytes(), 8).unwrap();
    assert!(matches!(refused(), SharedMixtureError::Format { found: 2, expected: 1, .. }));
}

#[test]
fn damage_never_leads_beyond_the_file() {
    let folder = tempdir_in("/dev/shm").unwrap();
    let path = folder.path().join("mixture");
    let _shared = SharedMixture::create(&path, &first(), 2).unwrap();
    let sound = fs::read(&path).unwrap();
    // Every byte of header and shape is covered by magic, format or checksum.
    for place in 0..52 {
        for bit in [1, 0x80] {
            let mut bytes = sound.clone();
            bytes[place] ^= bit;
            fs::write(&path, bytes).unwrap();
            let refused = MixtureReader::open(&path, 0);
            assert!(refused.is_err(), "byte {place}");
        }
    }
    for length in [0, 39, 45, 52, 4096, 8192, sound.len() / 2, sound.len() - 1] {
        fs::write(&path, &sound[..length]).unwrap();
        assert!(matches!(MixtureReader::open(&path, 0), Err(SharedMixtureError::Damaged { .. })), "{length}");
    }
    // The row of version 0 with each block number replaced by that of another component, in another extent, or out of
    // range. An extent has 22 blocks: one for each of six components and 16 spare ones.
    let words = 64 * 3 + 8 * (64 + 4 * 2);
    let row = 4096 + (words as usize).next_multiple_of(64);
    for place in 0..6 {
        for block in [(place + 1) % 6, 22, 1 << 20, u32::MAX] {
            let mut bytes = sound.clone();
            bytes[row + 4 * place as usize..][..4].copy_from_slice(&block.to_le_bytes());
            fs::write(&path, bytes).unwrap();
            let refused = MixtureReader::open(&path, 0).unwrap().pin(0);
            assert!(
                matches!(refused, Err(SharedMixtureError::Damaged { .. })),
                "{place} {block}: {refused:?}"
            );
        }
    }
}

/// Fills a small file system, where the system allows users to mount one.
#[test]
fn a_full_file_system_is_an_error() {
    let folder = tempdir_in("/dev/shm").unwrap();
    let script = r#"mount -t tmpfs -o size=512k none "$1" || exit 77
                    exec "$0" --exact mixture::files::in_a_small_file_system --ignored --nocapture"#;
    let namespace = ["--user", "--map-root-user", "--mount", "--propagation", "private"];
    let mut command = Command::new("unshare");
    command.args(namespace).args(["sh", "-c", script]).arg(std::env::current_exe().unwrap());
    let output = command.arg(folder.path()).env("SMALL_FILE_SYSTEM", folder.path()).output();
    match output {
        Ok(output) if output.status.success() => {}
        Ok(output) if output.status.code() == Some(101) => {
            panic!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
        }
        refused => eprintln!("not tried, since no file system can be mounted here: {refused:?}"),
    }
}

#[test]
#[ignore = "run by a_full_file_system_is_an_error"]
fn in_a_small_file_system() {
    let folder = std::env::var_os("SMALL_FILE_SYSTEM").expect("set by the test that runs this one");
    let path = Path::new(&folder).join("mixture");
    let mixture = first();
    let needed = SharedMixture::space_needed(&mixture, 2).unwrap();

    let ballast = Path::new(&folder).join("ballast");
    fs::write(&ballast, vec![1; 450_000]).unwrap();
    match SharedMixture::create(&path, &mixture, 2) {
        Err(SharedMixtureError::Full { needed: stated, free, .. }) => {
            assert_eq!(stated, needed);
            assert!(free < needed, "{free}");
        }
        Err(error) => panic!("{error}"),
        Ok(_) => panic!("{needed} bytes were found where there is no room"),
    }
    assert!(!path.exists());
    fs::remove_file(ballast).unwrap();

    let mut shared = SharedMixture::create(&path, &mixture, 2).unwrap();
    let mut kept = vec![mixture];
    let error = loop {
        let mixture = next(kept.last().unwrap());
        if let Err(error) = shared.publish(&mixture) {
            break error;
        }
        kept.push(mixture);
    };
    assert!(matches!(error, SharedMixtureError::Full { free: 0..8192, .. }), "{error}");
    assert!(kept.len() > 10, "{}", kept.len());
    // Existing versions remain, and freed space is used.
    let mut reader = MixtureReader::open(&path, 0).unwrap();
    kept.iter().skip(1).for_each(|mixture| check(&reader.pin(mixture.version()).unwrap()));
    let newest = kept.pop().unwrap();
    kept.clear();
    let mixture = next(&newest);
    shared.publish(&mixture).unwrap();
    check(&reader.pin(mixture.version()).unwrap());
}
