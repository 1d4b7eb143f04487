//! A connection to the server that loses replies to commits: the server commits, but the client never gets the reply.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;

use atoms::{Cell, Structure};
use store::JobState;
use wire::ContentHash;

use crate::common::campaign::Small;
use crate::common::label_campaign::{LabelCampaign, on_store, queue};
use crate::common::processes::wait_until;
use crate::common::random;

/// Percentage of replies to commits that are lost.
const LOST: u64 = 12;

/// The proxy's address, and its counters.
struct LossyLine {
    here: String,
    commits: Arc<AtomicU64>,
    lost: Arc<AtomicU64>,
}

impl LossyLine {
    fn to(there: &str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let here = listener.local_addr().unwrap().to_string();
        let line = Self { here, commits: Arc::default(), lost: Arc::default() };
        let (there, commits, lost) = (there.to_owned(), Arc::clone(&line.commits), Arc::clone(&line.lost));
        thread::spawn(move || {
            for near in listener.incoming().flatten() {
                let Ok(far) = TcpStream::connect(&there) else { continue };
                let breaks = Arc::new(AtomicBool::new(false));
                let (from, to) = (near.try_clone().unwrap(), far.try_clone().unwrap());
                let (commits, lost, asked) = (Arc::clone(&commits), Arc::clone(&lost), Arc::clone(&breaks));
                thread::spawn(move || {
                    // An error here means that either end has closed the connection.
                    let _ = questions(&from, &to, &asked, &commits, &lost);
                    close(&from, &to);
                });
                thread::spawn(move || {
                    let _ = answers(&far, &near, &breaks);
                    close(&far, &near);
                });
            }
        });
        line
    }
}

fn close(one: &TcpStream, other: &TcpStream) {
    for stream in [one, other] {
        // It may be closed already.
        let _ = stream.shutdown(Shutdown::Both);
    }
}

/// Forwards the client's messages: a startup message, then messages of a type byte, a length and content.
fn questions(
    mut from: &TcpStream,
    mut to: &TcpStream,
    breaks: &AtomicBool,
    commits: &AtomicU64,
    lost: &AtomicU64,
) -> io::Result<()> {
    let mut head = vec![0; 4];
    from.read_exact(&mut head)?;
    to.write_all(&with_content(from, head)?)?;
    loop {
        let mut head = vec![0; 5];
        from.read_exact(&mut head)?;
        let message = with_content(from, head)?;
        if message.starts_with(b"Q") && message.ends_with(b"COMMIT\0") {
            let number = commits.fetch_add(1, Ordering::SeqCst);
            if random(number) % 100 < LOST {
                lost.fetch_add(1, Ordering::SeqCst);
                breaks.store(true, Ordering::SeqCst);
            }
        }
        to.write_all(&message)?;
    }
}

/// Reads the rest of a message whose header (an optional type byte, and the length, which counts itself) is given.
fn with_content(mut from: &TcpStream, mut message: Vec<u8>) -> io::Result<Vec<u8>> {
    let begin = message.len();
    let length = u32::from_be_bytes(message[begin - 4..].try_into().unwrap()) as usize;
    message.resize(begin + length - 4, 0);
    from.read_exact(&mut message[begin..])?;
    Ok(message)
}

/// Forwards the server's replies until one is to be lost: then the server has committed, and the connection breaks.
fn answers(mut from: &TcpStream, mut to: &TcpStream, breaks: &AtomicBool) -> io::Result<()> {
    let mut buffer = vec![0; 1 << 16];
    loop {
        let read = from.read(&mut buffer)?;
        if read == 0 || breaks.load(Ordering::SeqCst) {
            return Ok(());
        }
        to.write_all(&buffer[..read])?;
    }
}

/// An fcc aluminium cell of four atoms.
fn small(number: u64) -> Structure {
    let a = 4.0 + 1e-3 * number as f64;
    let half = 0.5 * a;
    Structure {
        species: vec!["Al".parse().unwrap(); 4],
        positions: vec![[0.0; 3], [0.0, half, half], [half, 0.0, half], [half, half, 0.0]],
        cell: Cell::orthorhombic(a, a, a),
        periodic: [true; 3],
    }
}

/// Labellers lose replies when they lease jobs, deliver labels and send heartbeats; each job gets one label, and none hangs.
#[test]
fn answers_to_commits_get_lost_and_no_job_does() {
    const JOBS: u64 = 47;
    let place = LabelCampaign::on_server(&Small { steps: 60, ..Small::default() }, &[]);
    assert_eq!(place.run().0.wait().unwrap().code(), Some(0), "{}", place.said());
    let structures: Vec<_> = (0..JOBS).map(small).collect();
    for (structure, step) in structures.iter().zip(1..) {
        queue(place.location(), 10_000 + step, structure.clone(), Vec::new());
    }
    let url = place.argument();
    let there = url.split_once('@').unwrap().1.split_once('/').unwrap().0;
    let line = LossyLine::to(there);
    let lossy = format!("{}&sslmode=disable", url.replacen(there, &line.here, 1));
    let mut labelling = place.start(&["label", "--store", &lossy]);
    let mut ended = None;
    wait_until("everything is labelled", || {
        ended = labelling.0.try_wait().unwrap();
        ended.is_some()
    });
    assert_eq!(ended.unwrap().code(), Some(0), "{}", place.said());
    on_store(place.location(), async |store| {
        for state in [JobState::Queued, JobState::Leased, JobState::Failed] {
            let left = store.queue_list(Some(state), 9, 0).await.unwrap();
            assert!(left.is_empty(), "{left:#?} {}", place.said());
        }
        for structure in &structures {
            let labels = store.labels_of(ContentHash::from_structure(structure)).await.unwrap();
            assert_eq!(labels.len(), 1, "{labels:?}");
        }
    });
    let (commits, lost) = (line.commits.load(Ordering::SeqCst), line.lost.load(Ordering::SeqCst));
    assert!(lost >= 5, "{lost} answers to {commits} commits were lost");
}
