//! Diagnoses why a connection fails although the other side listens, by a separate TLS handshake: zenoh does not report
//! the reason.

use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::ServerName;
use rustls::version::TLS13;
use rustls::{AlertDescription, CertificateError as Refusal, ClientConfig, ClientConnection};

use super::certificates::{Tls, provider};
use super::endpoint::Endpoint;

/// Timeout of each step of the handshake.
const STEP_TIMEOUT: Duration = Duration::from_secs(5);
/// Time within which the other side rejects our certificate, if it does.
const REJECTION_TIMEOUT: Duration = Duration::from_secs(2);

/// A certificate that prevents a connection.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HandshakeError {
    /// This host rejects the orchestrator's certificate.
    #[error(
        "the certificate of the orchestrator at {endpoint} is not acceptable: {why}; give the orchestrator one \
         for the name to which agents connect, signed by the authority in {authority} (docs/hosts.md, \"Certificates\")"
    )]
    ServerCertificate {
        /// Endpoint of the orchestrator.
        endpoint: Endpoint,
        /// The reason.
        why: String,
        /// The authority that this host trusts.
        authority: String,
    },
    /// The orchestrator rejects this host's certificate.
    #[error(
        "the orchestrator at {endpoint} rejects the certificate in {certificate}: {why}; give this host one that the \
         orchestrator's authority has signed (docs/hosts.md, \"Certificates\")"
    )]
    ClientCertificate {
        /// Endpoint of the orchestrator.
        endpoint: Endpoint,
        /// The reason.
        why: String,
        /// File of the rejected certificate.
        certificate: String,
    },
}

/// Attempts a handshake and returns the certificate error, if there is one. Blocks for up to a few seconds.
pub(super) fn probe(endpoint: &Endpoint, tls: &Tls) -> Result<(), HandshakeError> {
    let Some((mut connection, mut stream)) = connect(endpoint, tls) else { return Ok(()) };
    while connection.is_handshaking() {
        if let Err(error) = connection.complete_io(&mut stream) {
            return classify(&error, endpoint, tls);
        }
    }
    // The orchestrator validates our certificate only now; if it accepts it, it waits for data.
    let result = stream.set_read_timeout(Some(REJECTION_TIMEOUT)).and_then(|()| {
        let mut tls_stream = rustls::Stream::new(&mut connection, &mut stream);
        tls_stream.flush()?;
        tls_stream.read(&mut [0])
    });
    result.map_or_else(|error| classify(&error, endpoint, tls), |_| Ok(()))
}

/// A connection before the handshake; `None` if no process listens.
fn connect(endpoint: &Endpoint, tls: &Tls) -> Option<(ClientConnection, TcpStream)> {
    let credentials = tls.load().ok()?;
    let config = ClientConfig::builder_with_provider(Arc::new(provider()))
        .with_protocol_versions(&[&TLS13])
        .ok()?
        .with_root_certificates(credentials.roots)
        .with_client_auth_cert(credentials.chain, credentials.key)
        .ok()?;
    let name = ServerName::try_from(endpoint.plain_host().to_owned()).ok()?;
    let connection = ClientConnection::new(Arc::new(config), name).ok()?;
    let addresses = (endpoint.plain_host(), endpoint.port()).to_socket_addrs().ok()?;
    let stream =
        addresses.into_iter().find_map(|address| TcpStream::connect_timeout(&address, STEP_TIMEOUT).ok())?;
    stream.set_read_timeout(Some(STEP_TIMEOUT)).ok()?;
    stream.set_write_timeout(Some(STEP_TIMEOUT)).ok()?;
    Some((connection, stream))
}

/// The certificate error behind an I/O error; none if the connection broke or the other side does not use TLS.
fn classify(error: &io::Error, endpoint: &Endpoint, tls: &Tls) -> Result<(), HandshakeError> {
    let endpoint = endpoint.clone();
    match error.get_ref().and_then(|source| source.downcast_ref::<rustls::Error>()) {
        Some(rustls::Error::InvalidCertificate(why)) => {
            let authority = tls.authority.display().to_string();
            Err(HandshakeError::ServerCertificate { endpoint, why: describe(why), authority })
        }
        Some(rustls::Error::AlertReceived(alert)) => {
            let certificate = tls.certificate.display().to_string();
            let refused = alert_reason(*alert).map(|why| HandshakeError::ClientCertificate {
                endpoint,
                why: why.to_owned(),
                certificate,
            });
            refused.map_or(Ok(()), Err)
        }
        _ => Ok(()),
    }
}

fn describe(why: &Refusal) -> String {
    match why {
        Refusal::UnknownIssuer | Refusal::BadSignature => "it is signed by another authority".to_owned(),
        Refusal::NotValidForNameContext { expected, presented } => {
            let presented: Vec<_> = presented.iter().map(|name| bare_name(name)).collect();
            format!("it is for {}, not for {}", presented.join(", "), expected.to_str())
        }
        Refusal::Expired | Refusal::ExpiredContext { .. } => {
            "it has expired, or this host's clock is wrong".to_owned()
        }
        Refusal::NotValidYet | Refusal::NotValidYetContext { .. } => {
            "it is not valid yet, or this host's clock is wrong".to_owned()
        }
        other => other.to_string(),
    }
}

/// The name in `DnsName("head")`.
fn bare_name(name: &str) -> &str {
    let inside = name.split_once('(').and_then(|(_, rest)| rest.strip_suffix(')'));
    inside.unwrap_or(name).trim_matches('"')
}

/// The reason given by an alert, if it concerns our certificate.
fn alert_reason(alert: AlertDescription) -> Option<&'static str> {
    match alert {
        AlertDescription::UnknownCA | AlertDescription::DecryptError => {
            Some("it is signed by another authority")
        }
        AlertDescription::CertificateExpired => {
            Some("it has expired or is not valid yet, or a clock is wrong")
        }
        AlertDescription::BadCertificate
        | AlertDescription::UnsupportedCertificate
        | AlertDescription::CertificateUnknown
        | AlertDescription::CertificateRevoked
        | AlertDescription::AccessDenied => Some("it is not acceptable"),
        _ => None,
    }
}
