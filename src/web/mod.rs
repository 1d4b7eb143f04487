//! Serves a campaign over HTTP, to this host only.

pub mod agent_metrics;
mod connections;
pub mod dashboard;
pub mod exposition;
pub mod metrics;
mod security;
mod server;

use std::net::SocketAddr;

use axum::Router;
use monitor::mixture_status::InitialMixture;
use store::{Location, Store};
use tokio::net::TcpListener;

use self::dashboard::{Dashboard, Mutations};
pub use self::server::HttpServer;
use crate::exit_status::CommandError;
use crate::output::{log_and_print, print_stderr};

/// Options for the addresses to serve on.
#[derive(Debug, clap::Args)]
pub struct ListenArgs {
    /// Serve the dashboard to web browsers at this address, such as 127.0.0.1:8080 (docs/dashboard.md)
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = address)]
    dashboard: Option<SocketAddr>,
    /// Serve metrics to Prometheus at this address, such as 127.0.0.1:9464 (docs/metrics.md)
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = address)]
    metrics: Option<SocketAddr>,
}

/// Parses an address to serve on.
pub fn address(text: &str) -> Result<SocketAddr, String> {
    let of_this_host = text.strip_prefix("localhost:").map(|port| format!("127.0.0.1:{port}"));
    of_this_host.as_deref().unwrap_or(text).parse().map_err(|_| {
        let example = match text.trim_start_matches(':').parse::<u16>() {
            Ok(port) => format!("127.0.0.1:{port}"),
            Err(_) => "127.0.0.1:8080".to_owned(),
        };
        format!("expected ADDRESS:PORT, such as {example}")
    })
}

/// The bound listeners.
#[derive(Debug)]
pub struct BoundListeners {
    dashboard: Option<TcpListener>,
    metrics: Option<TcpListener>,
}

/// The running servers. They stop on drop.
#[derive(Debug, Default)]
pub struct RunningServers {
    servers: Vec<HttpServer>,
    read_store: Option<Store>,
}

impl RunningServers {
    /// Stops the servers and closes their store. The last process that closes a database cleans it up.
    pub async fn end(self) {
        self.servers.iter().for_each(HttpServer::end);
        if let Some(read_store) = &self.read_store {
            read_store.close().await;
        }
    }
}

impl Drop for RunningServers {
    fn drop(&mut self) {
        self.servers.iter().for_each(HttpServer::end);
    }
}

impl ListenArgs {
    /// Binds the addresses before any work begins.
    pub async fn listen(&self) -> Result<BoundListeners, CommandError> {
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
    /// Starts the servers. They read through separate connections, so that frequent requests do not slow the
    /// campaign. Mutations go through `store`. `initial` is the mixture with which the campaign began, unless it changes with the
    /// version of the potential.
    pub async fn serve(
        self,
        location: &Location,
        store: &Store,
        initial: Option<InitialMixture>,
    ) -> Result<RunningServers, CommandError> {
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
            let mutations = Mutations::new(store.clone())?;
            let address = listener.local_addr().map_err(CommandError::failed)?;
            tracing::info!("dashboard at http://{address}/");
            // Print the token, but do not log it.
            print_stderr(format_args!("dashboard at http://{address}/#token={}", mutations.token()));
            let router = Dashboard::new(read_store, Some(mutations), initial).router();
            serving.servers.push(HttpServer::start(listener, router));
        }
        Ok(serving)
    }
}

/// Binds an address before any work begins. Requests are not authenticated, so the address must be loopback.
pub async fn listen(address: SocketAddr) -> Result<TcpListener, CommandError> {
    if !address.ip().is_loopback() {
        return Err(CommandError::Input(format!(
            "will not listen on {address}: anyone who reaches it could read the campaign; use a loopback address such as \
             127.0.0.1:{port}, and reach it from other hosts with ssh -L {port}:127.0.0.1:{port}",
            port = address.port()
        )));
    }
    TcpListener::bind(address).await.map_err(|error| {
        CommandError::Input(format!(
            "cannot listen on {address}: {error}; use another port, or port 0 for any free one"
        ))
    })
}

/// Prints the address of the metrics and serves them.
pub fn serve_metrics(listener: TcpListener, router: Router) -> Result<HttpServer, CommandError> {
    let address = listener.local_addr().map_err(CommandError::failed)?;
    log_and_print(format_args!("metrics at http://{address}/metrics"));
    Ok(HttpServer::start(listener, router))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_need_a_host_and_a_port() {
        assert_eq!(address("127.0.0.1:8080"), Ok(([127, 0, 0, 1], 8080).into()));
        assert_eq!(address("localhost:8080"), address("127.0.0.1:8080"));
        for text in ["9464", ":9464"] {
            assert_eq!(address(text).unwrap_err(), "expected ADDRESS:PORT, such as 127.0.0.1:9464");
        }
        for text in ["", "host", "host:8080", "127.0.0.1", "127.0.0.1:99999"] {
            assert_eq!(address(text).unwrap_err(), "expected ADDRESS:PORT, such as 127.0.0.1:8080", "{text}");
        }
    }
}
