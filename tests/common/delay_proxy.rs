//! A TCP proxy that delays everything.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

/// Listening address, as `127.0.0.1:port`, and the number of bytes forwarded.
pub struct DelayProxy {
    pub address: String,
    bytes_forwarded: Arc<AtomicUsize>,
}

impl DelayProxy {
    /// Listens for connections to `target` and forwards data in both directions after `delay`.
    pub fn to(target: &str, delay: Duration) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let (address, bytes_forwarded) =
            (listener.local_addr().unwrap().to_string(), Arc::new(AtomicUsize::new(0)));
        let (target, count) = (target.to_owned(), Arc::clone(&bytes_forwarded));
        thread::spawn(move || {
            for near in listener.incoming().flatten() {
                // If nothing listens there yet, the client tries again.
                let Ok(far) = TcpStream::connect(&target) else { continue };
                forward(near.try_clone().unwrap(), far.try_clone().unwrap(), delay, Arc::clone(&count));
                forward(far, near, delay, Arc::clone(&count));
            }
        });
        Self { address, bytes_forwarded }
    }

    pub fn bytes_forwarded(&self) -> usize {
        self.bytes_forwarded.load(Ordering::Relaxed)
    }
}

fn forward(mut from: TcpStream, mut to: TcpStream, delay: Duration, count: Arc<AtomicUsize>) {
    let (sender, receiver) = mpsc::channel::<(Instant, Vec<u8>)>();
    thread::spawn(move || {
        let mut buffer = vec![0; 1 << 16];
        while let Ok(read @ 1..) = from.read(&mut buffer) {
            if sender.send((Instant::now() + delay, buffer[..read].to_vec())).is_err() {
                return;
            }
        }
    });
    thread::spawn(move || {
        for (due, bytes) in receiver {
            sleep(due.saturating_duration_since(Instant::now()));
            if to.write_all(&bytes).is_err() {
                break;
            }
            count.fetch_add(bytes.len(), Ordering::Relaxed);
        }
        // It may be closed already.
        let _ = to.shutdown(Shutdown::Both);
    });
}
