//! What a campaign shows over HTTP, to this host only.

pub mod agent_metrics;
mod connections;
pub mod dashboard;
pub mod exposition;
pub mod metrics;
mod security;
mod server;

use std::net::SocketAddr;

use axum::Router;
use calm::Artifact;
use store::{Location, Store};
use tokio::net::TcpListener;

use self::dashboard::{Dashboard, Mutations};
pub use self::server::Server;
use crate::exit_status::Failure;
use crate::mixture_status::InitialMixture;
use crate::output::{log_and_print, print_stderr};

/// Where a campaign is shown, as arguments.
#[derive(Debug, clap::Args)]
pub struct ListenAddresses {
    /// Show the campaign in a browser at this address of this host, as 127.0.0.1:8080 (docs/dashboard.md)
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = address)]
    dashboard: Option<SocketAddr>,
    /// Serve metrics for Prometheus at this address of this host, as 127.0.0.1:9464 (docs/metrics.md)
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = address)]
    metrics: Option<SocketAddr>,
}

/// An address to serve on, as an argument.
pub fn address(text: &str) -> Result<SocketAddr, String> {
    let of_this_host = text.strip_prefix("localhost:").map(|port| format!("127.0.0.1:{port}"));
    of_this_host.as_deref().unwrap_or(text).parse().map_err(|_| {
        let example = match text.trim_start_matches(':').parse::<u16>() {
            Ok(port) => format!("127.0.0.1:{port}"),
            Err(_) => "127.0.0.1:8080".to_owned(),
        };
        format!("expected ADDRESS:PORT, as {example}")
    })
}

/// The same, held.
#[derive(Debug)]
pub struct BoundListeners {
    dashboard: Option<TcpListener>,
    metrics: Option<TcpListener>,
}

/// What is served, until this is dropped.
#[derive(Debug, Default)]
pub struct RunningServers {
    servers: Vec<Server>,
    read_store: Option<Store>,
}

impl RunningServers {
    /// Serves no more, and closes what was read from: whoever closes a database last tidies it up.
    pub async fn end(self) {
        self.servers.iter().for_each(Server::end);
        if let Some(read_store) = &self.read_store {
            read_store.close().await;
        }
    }
}

impl Drop for RunningServers {
    fn drop(&mut self) {
        self.servers.iter().for_each(Server::end);
    }
}

impl ListenAddresses {
    /// Takes the addresses, before any work begins that would be in vain.
    pub async fn listen(&self) -> Result<BoundListeners, Failure> {
        let (mut dashboard, mut metrics) = (None, None);
        if let Some(address) = self.dashboard {
            dashboard = Some(listen(address).await?);
        }
        if let Some(address) = self.metrics {
            metrics = Some(listen(address).await?);
        }
        Ok(BoundListeners { dashboard, metrics })
    }
}

impl BoundListeners {
    /// Begins to serve. What is shown is read through connections of its own: whoever asks often does not keep the campaign
    /// waiting. What is changed goes through `store`.
    pub async fn serve(
        self,
        location: &Location,
        store: &Store,
        artifact: &Artifact,
    ) -> Result<RunningServers, Failure> {
        let mut serving = RunningServers::default();
        if self.dashboard.is_none() && self.metrics.is_none() {
            return Ok(serving);
        }
        let read_store = Store::open_read_only(location).await?;
        serving.read_store = Some(read_store.clone());
        if let Some(listener) = self.metrics {
            serving.servers.push(serve_metrics(listener, metrics::router(read_store.clone()))?);
        }
        if let Some(listener) = self.dashboard {
            let original =
                InitialMixture { symbols: artifact.symbols.clone(), mixture: artifact.mixture.clone() };
            let mutations = Mutations::new(store.clone())?;
            let address = listener.local_addr().map_err(Failure::failed)?;
            tracing::info!("dashboard at http://{address}/");
            // The token is for whoever reads this, and for no file.
            print_stderr(format_args!("dashboard at http://{address}/#token={}", mutations.token()));
            let router = Dashboard::new(read_store, Some(mutations), Some(original)).router();
            serving.servers.push(Server::start(listener, router));
        }
        Ok(serving)
    }
}

/// An address to serve on, before any work begins that would be in vain. What is served asks nobody who he is, so it is
/// one of this host.
pub async fn listen(address: SocketAddr) -> Result<TcpListener, Failure> {
    if !address.ip().is_loopback() {
        return Err(Failure::Input(format!(
            "will not listen on {address}: whoever reaches it could read the campaign; name an address of this host, as \
             127.0.0.1:{port}, and reach it from elsewhere with ssh -L {port}:127.0.0.1:{port}",
            port = address.port()
        )));
    }
    TcpListener::bind(address).await.map_err(|error| {
        Failure::Input(format!(
            "cannot listen on {address}: {error}; name another port, or port 0 for any that is free"
        ))
    })
}

/// Says where metrics are served, and serves them.
pub fn serve_metrics(listener: TcpListener, router: Router) -> Result<Server, Failure> {
    let address = listener.local_addr().map_err(Failure::failed)?;
    log_and_print(format_args!("metrics at http://{address}/metrics"));
    Ok(Server::start(listener, router))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_told_from_ports() {
        assert_eq!(address("127.0.0.1:8080"), Ok(([127, 0, 0, 1], 8080).into()));
        assert_eq!(address("localhost:8080"), address("127.0.0.1:8080"));
        for text in ["9464", ":9464"] {
            assert_eq!(address(text).unwrap_err(), "expected ADDRESS:PORT, as 127.0.0.1:9464");
        }
        for text in ["", "host", "host:8080", "127.0.0.1", "127.0.0.1:99999"] {
            assert_eq!(address(text).unwrap_err(), "expected ADDRESS:PORT, as 127.0.0.1:8080", "{text}");
        }
    }
}
