//! Readers in other processes, killed at random times.

use std::io::{Read, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use calm::Mixture;
use wire::{MixtureReader, SharedMixture, SharedMixtureError};

use super::helpers::{Random, check, first, next};

const READERS: u32 = 6;
const VERSIONS: u64 = 3000;

/// A reader's process, and the version assigned to it.
struct Peer {
    child: Child,
    to_child: Option<ChildStdin>,
    answers: Receiver<u64>,
    promised: Option<Arc<Mixture>>,
}

impl Peer {
    fn start(path: &Path, number: u32) -> Self {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "mixture::processes::reader_process", "--ignored", "--nocapture"])
            .env("SHARED_MIXTURE", path)
            .env("READER", number.to_string())
            .stdin(Stdio::piped())
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        let to_child = child.stdin.take();
        // The test harness writes to stdout, so answers use stderr, which also shows panics.
        let mut from_child = child.stderr.take().unwrap();
        let (sender, answers) = channel();
        std::thread::spawn(move || {
            let mut answer = [0; 8];
            while from_child.read_exact(&mut answer).is_ok()
                && sender.send(u64::from_le_bytes(answer)).is_ok()
            {}
        });
        Self { child, to_child, answers, promised: None }
    }

    fn promise(&mut self, mixture: &Arc<Mixture>) {
        self.promised = Some(Arc::clone(mixture));
        self.to_child.as_mut().unwrap().write_all(&mixture.version().to_le_bytes()).unwrap();
    }

    /// Takes the answer if it has arrived; the version then need not be kept any longer.
    fn answered(&mut self, number: u32) {
        if let Ok(answer) = self.answers.try_recv() {
            let promised = self.promised.take().map(|mixture| mixture.version());
            assert_eq!(Some(answer), promised, "reader {number}: {:?}", self.child.try_wait());
        }
    }

    fn kill(&mut self) {
        self.child.kill().unwrap();
        let status = self.child.wait().unwrap();
        assert_eq!(status.signal(), Some(9), "a reader had ended by itself: {status}");
    }
}

#[test]
fn readers_in_other_processes_see_complete_versions_and_may_be_killed() {
    let folder = tempfile::tempdir_in("/dev/shm").unwrap();
    let path: PathBuf = folder.path().join("mixture");
    let mut mixture = first();
    let mut shared = SharedMixture::create(&path, &mixture, READERS).unwrap();
    let mut peers: Vec<Peer> = (0..READERS).map(|number| Peer::start(&path, number)).collect();
    let (mut random, mut kept, mut kills) = (Random(11), Vec::new(), 0);
    while mixture.version() < VERSIONS {
        mixture = next(&mixture);
        shared.publish(&mixture).unwrap();
        kept.push(Arc::clone(&mixture));
        kept.drain(..kept.len().saturating_sub(5));
        for (number, peer) in (0..).zip(&mut peers) {
            peer.answered(number);
            if peer.promised.is_none() {
                peer.promise(&kept[random.below(kept.len())]);
            }
        }
        if random.below(60) == 0 {
            std::thread::sleep(Duration::from_micros(random.next() % 3000));
            let number = random.below(peers.len());
            peers[number].kill();
            shared.release(number as u32);
            peers[number] = Peer::start(&path, number as u32);
            kills += 1;
        }
    }
    assert!(kills > 20, "{kills}");
    for mut peer in peers {
        drop(peer.to_child.take());
        assert!(peer.child.wait().unwrap().success());
    }
    // Nothing remains of dead readers: the file does not grow.
    kept.clear();
    for _ in 0..3 {
        mixture = next(&mixture);
        shared.publish(&mixture).unwrap();
    }
    let taken = 512 * std::os::unix::fs::MetadataExt::blocks(&std::fs::metadata(&path).unwrap());
    let spare = 32 * 8192;
    let needed = SharedMixture::space_needed(&mixture, READERS).unwrap();
    assert!(taken <= needed + spare, "{taken} bytes are taken, {needed} at the start");
}

#[test]
#[ignore = "run by readers_in_other_processes_see_complete_versions_and_may_be_killed"]
fn reader_process() {
    let path = PathBuf::from(std::env::var_os("SHARED_MIXTURE").expect("set by the test that runs this one"));
    let number = std::env::var("READER").unwrap().parse().unwrap();
    let mut reader = MixtureReader::open(&path, number).unwrap();
    let (mut random, mut held) = (Random(u64::from(std::process::id())), Vec::new());
    let mut version = [0; 8];
    while std::io::stdin().read_exact(&mut version).is_ok() {
        let promised = reader.pin(u64::from_le_bytes(version)).unwrap();
        check(&promised);
        held.push(promised);
        for _ in 0..20 {
            let newest = reader.newest();
            match reader.pin(newest) {
                Ok(mixture) => held.push(mixture),
                // It was the newest version a moment ago, and was not assigned.
                Err(SharedMixtureError::VersionNotFound { .. }) => {}
                Err(error) => panic!("{error}"),
            }
            while held.len() > 4 {
                let mixture = held.swap_remove(random.below(held.len()));
                check(&mixture);
            }
        }
        std::io::stderr().write_all(&version).unwrap();
    }
    held.iter().for_each(|mixture| check(mixture));
}
