//! A user without the token opens as many connections to the dashboard as the system permits. The campaign continues, and its
//! owner is still served.
//!
//! `CALMWALK_FLOOD=5000 cargo test --test integration floods::` opens 5000 connections instead of 300.

use std::collections::VecDeque;
use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use crate::common;
use crate::common::Running;
use crate::common::campaign::{Small, outcome};
use crate::common::hosts::uninterrupted_outcome;
use crate::common::http::{first_event, request, said};
use crate::common::processes::{assert_no_leftovers, pause_walkers, processes_running, signal, wait_until};

/// Limit of file descriptors of the campaign's process.
const LIMIT: usize = 256;
/// Number of connections that the flood keeps open; new ones replace old ones.
const HELD: usize = 280;

/// Total number of connections of the flood.
fn connections() -> usize {
    std::env::var("CALMWALK_FLOOD").ok().and_then(|text| text.parse().ok()).unwrap_or(300)
}

/// Requests of the connections, in turn: none, a partial request, one with a partial body, and a complete one whose response
/// is not read.
const SAID: [&str; 4] = [
    "",
    "GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: ",
    "POST /api/walks/all/pause HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\n{",
    "GET /api/events HTTP/1.1\r\nHost: localhost\r\n\r\n",
];

/// Opens connections one after the other until it is dropped.
struct Flood {
    flowing: Arc<AtomicBool>,
    opened: Arc<AtomicUsize>,
    thread: Option<JoinHandle<()>>,
}

impl Flood {
    fn begin(address: &str) -> Self {
        let (flowing, opened) = (Arc::new(AtomicBool::new(true)), Arc::new(AtomicUsize::new(0)));
        let (flows, count, address) = (Arc::clone(&flowing), Arc::clone(&opened), address.to_owned());
        let thread = thread::spawn(move || {
            let mut held = VecDeque::new();
            while flows.load(Ordering::Relaxed) {
                let number = count.load(Ordering::Relaxed);
                if number > connections() {
                    thread::sleep(Duration::from_millis(5));
                }
                // Connecting fails once the campaign has ended.
                let Ok(mut stream) = TcpStream::connect(&address) else { continue };
                let _ = stream.write_all(SAID[number % SAID.len()].as_bytes());
                held.push_back(stream);
                held.drain(..held.len().saturating_sub(HELD));
                count.store(number + 1, Ordering::Relaxed);
            }
        });
        Self { flowing, opened, thread: Some(thread) }
    }

    fn opened(&self) -> usize {
        self.opened.load(Ordering::Relaxed)
    }
}

impl Drop for Flood {
    fn drop(&mut self) {
        self.flowing.store(false, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

#[test]
fn a_flood_of_connections_disturbs_neither_the_campaign_nor_its_user() {
    // A walker may be restarted only once.
    let small = Small::default();
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = small.write(here);
    let text = fs::read_to_string(&path).unwrap().replace("[run]", "[run]\nmax_restarts = 1");
    fs::write(&path, text).unwrap();
    let script = format!(
        "ulimit -n {LIMIT}; exec {} run campaign.toml --directory . --dashboard 127.0.0.1:0",
        env!("CARGO_BIN_EXE_calmwalk")
    );
    let mut command = Command::new("sh");
    command.args(["-c", &script]).current_dir(here).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut run = Running(command.spawn().unwrap());
    let [at] = said(&mut run.0, ["dashboard at http://"]);
    let (address, token) = at.split_once("/#token=").unwrap();
    let held = pause_walkers(here, 2);

    let flood = Flood::begin(address);
    wait_until("the flood has opened its connections", || flood.opened() >= connections());
    signal(held.pids()[0], "KILL");
    wait_until("the walker is replaced", || {
        processes_running(here, "walker").iter().any(|pid| !held.pids().contains(pid))
    });
    let allowed =
        request(address, "GET", "/api/actions", &[("x-calmwalk-token", token), ("Connection", "close")], "");
    assert_eq!(allowed.json(), serde_json::json!({ "possible": true, "token_is_right": true }));
    assert!(first_event(address, "/api/events")["status"].is_object());
    let taken = fs::read_dir(format!("/proc/{}/fd", run.0.id())).unwrap().count();
    assert!(taken < LIMIT * 7 / 8, "{taken} descriptors");
    drop(flood);

    held.resume();
    assert_eq!(run.0.wait().unwrap().code(), Some(0));
    assert_eq!(outcome(here), uninterrupted_outcome(&small));
    assert_no_leftovers(here);
}

#[test]
fn silent_connections_are_closed() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = Small::default().write(here);
    let text = fs::read_to_string(&path).unwrap();
    // The campaign waits for external labels.
    fs::write(&path, text.replace("[label]", "[label]\nconcurrency = 0")).unwrap();
    let mut command = common::program(here);
    command.args(["run", "campaign.toml", "--dashboard", "127.0.0.1:0"]);
    let mut run = Running(command.stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap());
    let [at] = said(&mut run.0, ["dashboard at http://"]);
    let (address, _) = at.split_once('/').unwrap();
    let connect = |text: &str| {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(300))).unwrap();
        stream.write_all(text.as_bytes()).unwrap();
        stream
    };
    let mut streams: Vec<_> = SAID[..3].iter().map(|text| connect(text)).collect();
    // A connection that stays idle after its response.
    streams.push(connect("GET /api/samples HTTP/1.1\r\nHost: localhost\r\n\r\n"));
    let answers = streams.into_iter().map(|mut stream| {
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).expect("it is closed within its time");
        String::from_utf8(answer).unwrap()
    });
    let answers: Vec<_> = answers.collect();
    assert_eq!(answers[0], "");
    assert!(answers[2].starts_with("HTTP/1.1 408 "), "{answers:?}");
    assert!(answers[3].starts_with("HTTP/1.1 200 "), "{answers:?}");

    // Requests that are too long are refused.
    let head = format!("GET /{} HTTP/1.1\r\nHost: localhost\r\n\r\n", "a".repeat(100_000));
    let headers = format!("GET / HTTP/1.1\r\nHost: localhost\r\n{}\r\n", "X: y\r\n".repeat(1000));
    for (text, status) in [(head, ["414", "431"]), (headers, ["431", "400"])] {
        let mut stream = TcpStream::connect(address).unwrap();
        // The server may close it before the whole request is sent.
        let _ = stream.write_all(text.as_bytes());
        let mut answer = [0; 12];
        if stream.read_exact(&mut answer).is_ok() {
            let answer = String::from_utf8_lossy(&answer);
            assert!(status.iter().any(|status| answer.ends_with(status)), "{answer}");
        }
    }
    let body = "x".repeat(1_000_000);
    let mut stream = connect(&format!(
        "POST /api/walks/all/pause HTTP/1.1\r\nHost: localhost\r\nContent-Length: {}\r\n\r\n",
        body.len()
    ));
    let mut answer = [0; 12];
    stream.read_exact(&mut answer).unwrap();
    assert_eq!(String::from_utf8_lossy(&answer), "HTTP/1.1 413");
}
