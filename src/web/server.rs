//! Serves a listener with limits on the number of connections ([`HttpConnections`]), on the time and length of requests,
//! and on the time to send responses.

use std::convert::Infallible;
use std::io;
use std::time::Duration;

use axum::body::{Body, HttpBody, to_bytes};
use axum::http::{HeaderMap, Request, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Router, middleware};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

use super::connections::{Admission, ConnectionGuard, ConnectionState, HttpConnections};
use super::security;

/// Time to receive the headers of a request, from the connection or the previous response.
const HEADER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time to receive the body of a request.
const BODY_TIMEOUT: Duration = Duration::from_secs(5);
/// Time for the client to receive a response.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(60);
/// Request line and headers, bytes.
const MAX_HEADER_BYTES: usize = 16 << 10;
const MAX_HEADERS: usize = 64;
/// Body of a request, bytes.
const MAX_BODY_BYTES: usize = 16 << 10;
/// Pause after the system has refused to accept a connection.
const ACCEPT_RETRY_INTERVAL: Duration = Duration::from_millis(200);

/// A server with its connections.
#[derive(Debug)]
pub struct HttpServer {
    listening: AbortHandle,
    connections: HttpConnections,
}

impl HttpServer {
    /// Serves in a background task until [`Self::end`].
    pub fn start(listener: TcpListener, router: Router) -> Self {
        let router = router.layer(middleware::from_fn(security::require_local_host));
        let connections = HttpConnections::default();
        let listening = tokio::spawn(accept(listener, router, connections.clone())).abort_handle();
        Self { listening, connections }
    }

    /// Stops listening and closes all connections.
    pub fn end(&self) {
        self.listening.abort();
        self.connections.close();
    }
}

async fn accept(listener: TcpListener, router: Router, connections: HttpConnections) {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => {
                if let Some(stream) = admit(stream, &connections).await {
                    let router = router.clone();
                    connections.add(|guard| tokio::spawn(serve(stream, router, guard)));
                }
            }
            // The client has gone, or a resource is exhausted.
            Err(error) if error.kind() == io::ErrorKind::ConnectionAborted => {}
            Err(error) => {
                tracing::debug!("cannot accept a connection: {error}");
                sleep(ACCEPT_RETRY_INTERVAL).await;
            }
        }
    }
}

/// Waits until the connection may be served. `None` if it is refused.
async fn admit(stream: TcpStream, connections: &HttpConnections) -> Option<TcpStream> {
    loop {
        match connections.admit(&stream) {
            Admission::Now => return Some(stream),
            Admission::AfterClosing(gone) => {
                // The task is aborted, and its connection is closed when it has ended.
                let _ = gone.await;
                return Some(stream);
            }
            Admission::Later(pause) => sleep(pause).await,
            Admission::Refuse => {
                tracing::debug!("a connection was closed: there are too many");
                return None;
            }
        }
    }
}

async fn serve(stream: TcpStream, router: Router, guard: ConnectionGuard) {
    let (guard, router) = (&guard, &TowerToHyperService::new(router));
    let answer = service_fn(move |request: Request<Incoming>| async move {
        let (head, body) = request.into_parts();
        let body = match read_body(Body::new(body)).await {
            Ok(body) => body,
            Err(refusal) => return Ok::<_, Infallible>(refusal),
        };
        guard.set_state(ConnectionState::Responding);
        let answer = router.call(Request::from_parts(head, body)).await;
        let is_events = answer.as_ref().is_ok_and(|answer| is_event_stream(answer.headers()));
        guard.set_state(if is_events { ConnectionState::Streaming } else { ConnectionState::Idle });
        answer
    });
    let mut protocol = http1::Builder::new();
    protocol
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIMEOUT)
        .max_buf_size(MAX_HEADER_BYTES)
        .max_headers(MAX_HEADERS);
    tokio::select! {
        // Errors of a connection concern its client only.
        _ = protocol.serve_connection(TokioIo::new(stream), answer) => {}
        () = wait_until_stalled(guard) => {}
    }
}

/// Waits until the client has read nothing of a response for too long. A connection that only waits for requests
/// times out before.
async fn wait_until_stalled(guard: &ConnectionGuard) {
    loop {
        let idle = guard.idle();
        if idle >= RESPONSE_TIMEOUT {
            return;
        }
        sleep((RESPONSE_TIMEOUT - idle).max(ACCEPT_RETRY_INTERVAL)).await;
    }
}

fn is_event_stream(headers: &HeaderMap) -> bool {
    headers.get(header::CONTENT_TYPE).is_some_and(|kind| kind.as_bytes().starts_with(b"text/event-stream"))
}

/// Reads the body of a request, or refuses one that is too long or too slow.
async fn read_body(body: Body) -> Result<Body, Response> {
    let too_long = || (StatusCode::PAYLOAD_TOO_LARGE, "the request is too long\n").into_response();
    if body.size_hint().lower() > MAX_BODY_BYTES as u64 {
        return Err(too_long());
    }
    match timeout(BODY_TIMEOUT, to_bytes(body, MAX_BODY_BYTES)).await {
        Ok(Ok(bytes)) => Ok(Body::from(bytes)),
        Ok(Err(_)) => Err(too_long()),
        Err(_) => Err((StatusCode::REQUEST_TIMEOUT, "the request took too long\n").into_response()),
    }
}
