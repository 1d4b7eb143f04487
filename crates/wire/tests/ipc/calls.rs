//! Calls of a service by many clients at once.

use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use wire::ipc::{CallClient, CallServer, IncomingCall};
use wire::shm_dir::ShmDir;

/// Clients at a time, and the calls of each.
const CLIENTS: u64 = 48;
const CALLS: u64 = 120;

/// The service answers in batches, as a device does, and answers may be longer than the service was told to expect.
#[test]
fn answers_of_any_length_reach_every_client() {
    let directory = tempfile::tempdir().unwrap();
    let place = ShmDir::for_campaign(directory.path()).unwrap();
    let prepared = place.prepare(1 << 26).unwrap();
    let server = CallServer::open(&place, 1, CLIENTS as u32, 64).unwrap();
    let (address, stop) = (server.address().clone(), CancellationToken::new());
    let (sender, calls) = mpsc::channel::<IncomingCall>();
    thread::scope(|scope| {
        let stopping = stop.clone();
        scope.spawn(move || server.run(&stopping, |call| sender.send(call).unwrap()).unwrap());
        scope.spawn(move || {
            while let Ok(first) = calls.recv() {
                thread::sleep(Duration::from_micros(300));
                for call in std::iter::once(first).chain(calls.try_iter().take(24)) {
                    let [length, value] = call.words()[..2] else { panic!("{call:?}") };
                    call.answer(length as usize, |words| words.fill(value));
                }
            }
        });
        let clients: Vec<_> = (0..CLIENTS)
            .map(|number| {
                let address = address.clone();
                scope.spawn(move || {
                    let client = CallClient::connect(&address, CancellationToken::new()).unwrap();
                    for call in 0..CALLS {
                        // Lengths from far below the expected one to hundreds of times of it, in no order.
                        let length =
                            1 + (number * 7919 + call * 104_729) % [50, 500, 5000, 30_000][call as usize % 4];
                        let value = number << 32 | call;
                        let write = |words: &mut [u64]| {
                            words.fill(0);
                            words[..2].copy_from_slice(&[length, value]);
                        };
                        let read =
                            |words: &[u64]| (words.len() as u64, words.iter().all(|word| *word == value));
                        let answer = client.call(2 + (length as usize) / 3, write, read).unwrap();
                        assert_eq!(answer, Some((length, true)), "client {number}, call {call}");
                    }
                })
            })
            .collect();
        clients.into_iter().for_each(|client| client.join().unwrap());
        stop.cancel();
    });
    drop(prepared);
    place.remove().unwrap();
}
