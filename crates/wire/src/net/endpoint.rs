//! Endpoints and their zenoh sessions.

use std::fmt;
use std::io;
use std::net::{IpAddr, TcpListener};
use std::str::FromStr;
use std::time::SystemTime;

use serde_json::{Value, json};
use zenoh::{Config, Session, Wait};

use super::NetError;
use super::certificates::Tls;
use super::side::ConnectionSide;

/// Where the orchestrator listens and agents connect: `tcp/HOST:PORT`. Listening on port 0 chooses a free port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoint {
    host: String,
    port: u16,
}

/// Text that is not a valid endpoint.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{found:?} is not an endpoint: expected tcp/HOST:PORT, for example tcp/head:7447 or tcp/[::1]:7447")]
pub struct EndpointError {
    /// The text.
    pub found: String,
}

impl Endpoint {
    /// Whether the endpoint can be reached only from this host.
    pub fn is_loopback(&self) -> bool {
        match self.plain_host().parse::<IpAddr>() {
            Ok(address) => address.is_loopback(),
            Err(_) => self.host == "localhost",
        }
    }

    /// Replaces port 0 by a currently free port.
    ///
    /// # Errors
    /// The host is not an address of this machine.
    pub(super) fn with_free_port(&self) -> io::Result<Self> {
        let port = match self.port {
            0 => TcpListener::bind((self.plain_host(), 0))?.local_addr()?.port(),
            port => port,
        };
        Ok(Self { host: self.host.clone(), port })
    }

    /// The endpoint for other hosts: replaces the unspecified address by this host's name.
    pub fn with_host_name(&self, name: &str) -> Result<Self, EndpointError> {
        let everywhere = self.plain_host().parse::<IpAddr>().is_ok_and(|address| address.is_unspecified());
        if everywhere { format!("tcp/{name}:{}", self.port).parse() } else { Ok(self.clone()) }
    }

    /// Host name or address, without the brackets of IPv6.
    pub fn plain_host(&self) -> &str {
        self.host.trim_start_matches('[').trim_end_matches(']')
    }

    pub(super) fn port(&self) -> u16 {
        self.port
    }

    /// The locator in zenoh's format.
    fn locator(&self, tls: bool) -> String {
        format!("{}/{}:{}", if tls { "tls" } else { "tcp" }, self.host, self.port)
    }
}

impl FromStr for Endpoint {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        let parse = || {
            let (host, port) = text.strip_prefix("tcp/")?.rsplit_once(':')?;
            let bracketed = host.starts_with('[') && host.ends_with(']');
            let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
            let good = if bracketed {
                host[1..host.len() - 1].parse::<std::net::Ipv6Addr>().is_ok()
            } else {
                !host.is_empty() && host.chars().all(plain)
            };
            good.then(|| Some(Self { host: host.to_owned(), port: port.parse().ok()? }))?
        };
        parse().ok_or_else(|| EndpointError { found: text.to_owned() })
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "tcp/{}:{}", self.host, self.port)
    }
}

/// Opens a session on an endpoint; an agent's session connects.
pub(super) async fn open(
    side: ConnectionSide,
    endpoint: &Endpoint,
    tls: Option<&Tls>,
) -> Result<Session, NetError> {
    if tls.is_none() && !endpoint.is_loopback() {
        return Err(NetError::Unprotected { endpoint: endpoint.clone() });
    }
    let config = config(side, endpoint, tls)?;
    // This call blocks its thread.
    let opened = tokio::task::spawn_blocking(move || zenoh::open(config).wait()).await;
    opened.map_err(|why| NetError::open(endpoint, why))?.map_err(|why| NetError::open(endpoint, why))
}

fn config(side: ConnectionSide, endpoint: &Endpoint, tls: Option<&Tls>) -> Result<Config, NetError> {
    let locators = json!([endpoint.locator(tls.is_some())]);
    let none = json!([]);
    let (mode, listen, connect) = match side {
        ConnectionSide::Orchestrator => ("router", locators, none),
        ConnectionSide::Agent => ("client", none, locators),
    };
    let mut settings = vec![
        ("mode", json!(mode)),
        ("listen/endpoints", listen),
        ("connect/endpoints", connect),
        // A single attempt at first; zenoh reconnects an established session indefinitely.
        ("connect/timeout_ms", json!(0)),
        ("connect/exit_on_failure", json!(true)),
        (
            "connect/retry",
            json!({ "period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 2.0 }),
        ),
        ("scouting/multicast/enabled", json!(false)),
        ("scouting/gossip/enabled", json!(false)),
        ("adminspace/enabled", json!(false)),
    ];
    if let Some(tls) = tls {
        let Tls { authority, certificate, key } = tls;
        tls.check(side, SystemTime::now())?;
        let (own, own_key) = match side {
            ConnectionSide::Orchestrator => ("listen_certificate", "listen_private_key"),
            ConnectionSide::Agent => ("connect_certificate", "connect_private_key"),
        };
        settings.push((
            "transport/link/tls",
            json!({ "root_ca_certificate": authority, own: certificate, own_key: key, "enable_mtls": true }),
        ));
    }
    let mut config = Config::default();
    for (key, value) in settings {
        let refused = |why| NetError::open(endpoint, format_args!("{key}: {why}"));
        config.insert_json5(key, &Value::to_string(&value)).map_err(refused)?;
    }
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_read_and_written() {
        for text in ["tcp/head:7447", "tcp/10.0.0.3:1", "tcp/[::1]:65535", "tcp/a-b.c_d:80"] {
            assert_eq!(text.parse::<Endpoint>().unwrap().to_string(), text);
        }
        for text in [
            "",
            "head:7447",
            "tcp/head",
            "tcp/head:",
            "tcp/head:70000",
            "tcp/:1",
            "udp/a:1",
            "tcp/a#iface=b:1",
            "tcp/[::g]:1",
        ] {
            assert!(text.parse::<Endpoint>().is_err(), "{text}");
        }
    }

    #[test]
    fn endpoints_for_other_hosts_have_name_and_port() {
        let endpoint = |text: &str| text.parse::<Endpoint>().unwrap();
        assert_eq!(endpoint("tcp/0.0.0.0:7").with_host_name("node7").unwrap(), endpoint("tcp/node7:7"));
        assert_eq!(endpoint("tcp/[::]:7").with_host_name("node7").unwrap(), endpoint("tcp/node7:7"));
        assert_eq!(endpoint("tcp/127.0.0.1:7").with_host_name("node7").unwrap(), endpoint("tcp/127.0.0.1:7"));
        assert!(endpoint("tcp/0.0.0.0:7").with_host_name("node 7").is_err());
        assert_ne!(endpoint("tcp/127.0.0.1:0").with_free_port().unwrap().port, 0);
        assert_eq!(endpoint("tcp/head:7").with_free_port().unwrap(), endpoint("tcp/head:7"));
    }

    #[test]
    fn only_loopback_is_loopback() {
        let loopback = |text: &str| text.parse::<Endpoint>().unwrap().is_loopback();
        assert!(
            ["tcp/127.0.0.1:1", "tcp/127.3.2.1:1", "tcp/localhost:1", "tcp/[::1]:1"]
                .into_iter()
                .all(loopback)
        );
        assert!(
            !["tcp/0.0.0.0:1", "tcp/[::]:1", "tcp/head:1", "tcp/localhost.example:1"]
                .into_iter()
                .any(loopback)
        );
    }
}
