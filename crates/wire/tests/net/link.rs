//! A link that can be cut: a TCP proxy.

use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

/// State of the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    Whole,
    /// Closes all connections and accepts no others.
    Cut,
    /// Forwards nothing, without closing connections.
    Dead,
}

pub struct Link {
    pub port: u16,
    state: Arc<watch::Sender<State>>,
}

impl Link {
    /// A link to a port of this host.
    pub async fn to(port: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let here = listener.local_addr().unwrap().port();
        let state = Arc::new(watch::channel(State::Whole).0);
        let states = Arc::clone(&state);
        tokio::spawn(async move {
            loop {
                let (near, _) = listener.accept().await.unwrap();
                if *states.borrow() != State::Cut {
                    tokio::spawn(join(near, port, states.subscribe()));
                }
            }
        });
        Self { port: here, state }
    }

    pub fn set(&self, state: State) {
        self.state.send_replace(state);
    }
}

async fn join(near: TcpStream, port: u16, mut state: watch::Receiver<State>) {
    let Ok(far) = TcpStream::connect(("127.0.0.1", port)).await else { return };
    let ((from_near, to_near), (from_far, to_far)) = (near.into_split(), far.into_split());
    let there = carry(from_near, to_far, state.clone());
    let back = carry(from_far, to_near, state.clone());
    tokio::select! {
        () = there => {}
        () = back => {}
        _ = state.wait_for(|state| *state == State::Cut) => {}
    }
}

async fn carry(
    mut from: impl AsyncReadExt + Unpin,
    mut to: impl AsyncWriteExt + Unpin,
    mut state: watch::Receiver<State>,
) {
    let mut buffer = vec![0; 1 << 16];
    loop {
        let Ok(read @ 1..) = from.read(&mut buffer).await else { return };
        if state.wait_for(|state| *state != State::Dead).await.is_err() {
            tokio::time::sleep(Duration::MAX).await;
        }
        if to.write_all(&buffer[..read]).await.is_err() {
            return;
        }
    }
}
