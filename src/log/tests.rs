use std::fs;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, SystemTime};

use tracing::{debug, info, warn};

use super::*;

fn log(file: &Path, format: LogFormat, level: LogLevel) -> impl Subscriber + Send + Sync + use<> {
    let file = OpenOptions::new().append(true).create(true).open(file).unwrap();
    LogFile { file, format, process: "walker 3".to_owned() }.with_level(level)
}

#[test]
fn an_event_is_one_line_whatever_it_says() {
    let (directory, started) = (tempfile::tempdir().unwrap(), SystemTime::now());
    for format in [LogFormat::Text, LogFormat::Json] {
        let path = directory.path().join("log");
        let said = || warn!(walk = 3_u64, gamma = 1.5, name = "a \"b\"\nc", "two\nlines, é");
        tracing::subscriber::with_default(log(&path, format, LogLevel::Info), said);
        let text = fs::read_to_string(&path).unwrap();
        assert_eq!(text.lines().count(), 1, "{text}");
        fs::remove_file(&path).unwrap();
        if format == LogFormat::Text {
            let pid = std::process::id();
            let (time, rest) = text.split_once(' ').unwrap();
            let time = humantime::parse_rfc3339(time).unwrap();
            assert!(started <= time + Duration::from_millis(1) && time <= SystemTime::now(), "{text}");
            let said = r#"two\nlines, é gamma=1.5 name="a \"b\"\nc" walk=3"#;
            assert_eq!(rest, format!("WARN  walker 3 [{pid}] {said}\n"));
        } else {
            let object: serde_json::Value = serde_json::from_str(&text).unwrap();
            assert_eq!(object["level"], "warn");
            assert_eq!(object["process"], "walker 3");
            assert_eq!(object["message"], "two\nlines, é");
            assert_eq!(
                object["fields"],
                serde_json::json!({ "walk": 3, "gamma": 1.5, "name": "a \"b\"\nc" })
            );
        }
    }
}

#[test]
fn lower_levels_and_events_of_libraries_are_omitted() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("log");
    tracing::subscriber::with_default(log(&path, LogFormat::Text, LogLevel::Info), || {
        debug!("too fine");
        info!("just right");
        info!(target: "zenoh::net", "of a library");
        warn!(target: "zenoh::net", "a warning");
        let _span = tracing::error_span!("nothing").entered();
    });
    let text = fs::read_to_string(&path).unwrap();
    let said: Vec<_> = text.lines().map(|line| line.split_once("] ").unwrap().1).collect();
    assert_eq!(said, ["just right", "a warning"]);
}

#[test]
fn lines_of_several_writers_do_not_interleave() {
    let directory = tempfile::tempdir().unwrap();
    let path = Arc::new(directory.path().join("log"));
    let writers: Vec<_> = (0..8_u64)
        .map(|writer| {
            let path = Arc::clone(&path);
            let long = "x".repeat(500 * writer as usize);
            thread::spawn(move || {
                // Each log opens the file separately, as separate processes do.
                tracing::subscriber::with_default(log(&path, LogFormat::Json, LogLevel::Info), || {
                    (0..200_u64).for_each(|line| info!(writer, line, "{long}"));
                });
            })
        })
        .collect();
    writers.into_iter().for_each(|writer| writer.join().unwrap());
    let text = fs::read_to_string(&*path).unwrap();
    let mut next = [0; 8];
    for line in text.lines() {
        let event: serde_json::Value = serde_json::from_str(line).unwrap();
        let writer = event["fields"]["writer"].as_u64().unwrap() as usize;
        assert_eq!(event["fields"]["line"], next[writer]);
        next[writer] += 1;
    }
    assert_eq!(next, [200; 8]);
}

#[test]
fn a_refused_connection_does_not_blame_the_limit_of_open_files() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("log");
    let hint = "Hint: increase the system open file limit.";
    for (why, expected) in [
        (
            "received fatal alert: CertificateUnknown",
            "a connection was refused: received fatal alert: CertificateUnknown",
        ),
        ("Too many open files (os error 24)", "Too many open files (os error 24). Hint: increase"),
    ] {
        let said = || warn!("{why}. {hint}");
        tracing::subscriber::with_default(log(&path, LogFormat::Text, LogLevel::Info), said);
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains(expected), "{text}");
        fs::remove_file(&path).unwrap();
    }
}
