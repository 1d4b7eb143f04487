//! A minimal HTTP client with arbitrary headers.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::Child;
use std::time::Duration;

use serde_json::Value;

/// A response.
#[derive(Clone, Debug)]
pub struct Answer {
    pub status: u16,
    /// Status line and headers.
    pub head: String,
    pub body: String,
}

impl Answer {
    /// The body as JSON.
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }
}

/// Sends a request. Without a `Host` header it uses the address.
pub fn request(address: &str, method: &str, path: &str, headers: &[(&str, &str)], body: &str) -> Answer {
    let mut stream = BufReader::new(send(address, method, path, headers, body));
    let mut head = String::new();
    while !head.ends_with("\r\n\r\n") {
        assert!(stream.read_line(&mut head).expect("a head") > 0, "the answer ends in its head: {head}");
    }
    let length = head.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.eq_ignore_ascii_case("content-length").then(|| value.trim().parse().expect("a length"))
    });
    // Some servers keep the connection open.
    let mut body = String::new();
    stream.take(length.unwrap_or(u64::MAX)).read_to_string(&mut body).expect("a body");
    if head.to_ascii_lowercase().contains("transfer-encoding: chunked") {
        body = joined_chunks(&body);
    }
    let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).expect("a status");
    Answer { status, head, body }
}

/// The content of a chunked body (RFC 9112, 7.1).
fn joined_chunks(mut body: &str) -> String {
    let mut joined = String::new();
    loop {
        let (size, rest) = body.split_once("\r\n").expect("the size of a chunk");
        let size = usize::from_str_radix(size, 16).expect("a hexadecimal size");
        if size == 0 {
            return joined;
        }
        joined.push_str(&rest[..size]);
        body = &rest[size + 2..];
    }
}

/// Sends a GET request.
pub fn get(address: &str, path: &str) -> Answer {
    request(address, "GET", path, &[], "")
}

/// Repeats a GET request until the result is computed.
pub fn get_computed(address: &str, path: &str) -> Value {
    let mut answer = get(address, path);
    while answer.status == 202 {
        std::thread::sleep(Duration::from_millis(20));
        answer = get(address, path);
    }
    assert_eq!(answer.status, 200, "{answer:?}");
    answer.json()
}

/// The first event of a stream of server-sent events, as JSON.
pub fn first_event(address: &str, path: &str) -> Value {
    let mut lines = BufReader::new(send(address, "GET", path, &[], "")).lines();
    let data = lines.find_map(|line| Some(line.expect("a line").strip_prefix("data: ")?.to_owned()));
    serde_json::from_str(&data.expect("an event")).expect("JSON")
}

/// Reads a stream of events in the background until this process or the stream ends.
pub fn listen(address: &str, path: &str) -> std::thread::JoinHandle<()> {
    let mut stream = send(address, "GET", path, &[], "");
    stream.set_read_timeout(None).expect("a socket");
    std::thread::spawn(move || drop(std::io::copy(&mut stream, &mut std::io::sink())))
}

fn send(address: &str, method: &str, path: &str, headers: &[(&str, &str)], body: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).expect("a server listens");
    stream.set_read_timeout(Some(Duration::from_secs(300))).expect("a socket");
    let mut text =
        format!("{method} {path} HTTP/1.1\r\nConnection: close\r\nContent-Length: {}\r\n", body.len());
    if !headers.iter().any(|(name, _)| *name == "Host") {
        text += &format!("Host: {address}\r\n");
    }
    headers.iter().for_each(|(name, value)| text += &format!("{name}: {value}\r\n"));
    write!(stream, "{text}\r\n{body}").expect("a request is sent");
    stream
}

/// The rest of the lines on standard error that start with `begins`. Keeps reading in the background.
pub fn said<const N: usize>(child: &mut Child, begins: [&str; N]) -> [String; N] {
    let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
    let mut found = begins.map(|_| None);
    while found.iter().any(Option::is_none) {
        let line = lines.next().expect("it says where it listens").expect("a line");
        for (begin, found) in begins.iter().zip(&mut found) {
            if let Some(rest) = line.strip_prefix(begin) {
                *found = Some(rest.to_owned());
            }
        }
    }
    std::thread::spawn(move || lines.for_each(drop));
    found.map(|found| found.expect("all are found"))
}
