//! Why no link comes about although somebody listens: found by a TLS handshake of our own. zenoh does not tell.

use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::ServerName;
use rustls::version::TLS13;
use rustls::{AlertDescription, CertificateError as Refusal, ClientConfig, ClientConnection};

use super::certificates::{Tls, provider};
use super::endpoint::Endpoint;

/// The other side takes so long for a step at most, or is not there.
const STEP_TIMEOUT: Duration = Duration::from_secs(5);
/// Within so long the other side says that it does not accept our certificate.
const REJECTION_TIMEOUT: Duration = Duration::from_secs(2);

/// Why two hosts will not speak to each other before one of them has another certificate.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HandshakeError {
    /// This host does not believe the orchestrator.
    #[error(
        "the certificate that the orchestrator shows at {endpoint} cannot be accepted: {why}; give the orchestrator one \
         for the name by which agents connect, of the authority in {authority} (docs/hosts.md, \"Certificates\")"
    )]
    ServerCertificate {
        /// Where it listens.
        endpoint: Endpoint,
        /// What is wrong with it.
        why: String,
        /// Whom this host trusts.
        authority: String,
    },
    /// The orchestrator does not believe this host.
    #[error(
        "the orchestrator at {endpoint} refuses the certificate in {certificate}: {why}; give this host one that the \
         orchestrator's authority has signed (docs/hosts.md, \"Certificates\")"
    )]
    ClientCertificate {
        /// Where it listens.
        endpoint: Endpoint,
        /// Its reason.
        why: String,
        /// The file that it refuses.
        certificate: String,
    },
}

/// Connects once and says why there can be no link, if that can be told. Blocks for up to some seconds.
pub(super) fn probe(endpoint: &Endpoint, tls: &Tls) -> Result<(), HandshakeError> {
    let Some((mut connection, mut stream)) = connect(endpoint, tls) else { return Ok(()) };
    while connection.is_handshaking() {
        if let Err(error) = connection.complete_io(&mut stream) {
            return classify(&error, endpoint, tls);
        }
    }
    // The orchestrator looks at our certificate only now, and waits for the first word if it likes it.
    let said = stream.set_read_timeout(Some(REJECTION_TIMEOUT)).and_then(|()| {
        let mut tls_stream = rustls::Stream::new(&mut connection, &mut stream);
        tls_stream.flush()?;
        tls_stream.read(&mut [0])
    });
    said.map_or_else(|error| classify(&error, endpoint, tls), |_| Ok(()))
}

/// A connection that has not said anything yet; `None` if nobody is there.
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

/// What an error means: nothing where the line broke, or whoever listens speaks no TLS.
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
        Refusal::UnknownIssuer | Refusal::BadSignature => "another authority has signed it".to_owned(),
        Refusal::NotValidForNameContext { expected, presented } => {
            let presented: Vec<_> = presented.iter().map(|name| bare(name)).collect();
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
fn bare(name: &str) -> &str {
    let inside = name.split_once('(').and_then(|(_, rest)| rest.strip_suffix(')'));
    inside.unwrap_or(name).trim_matches('"')
}

/// What an alert says of our certificate, if it speaks of that.
fn alert_reason(alert: AlertDescription) -> Option<&'static str> {
    match alert {
        AlertDescription::UnknownCA | AlertDescription::DecryptError => {
            Some("another authority has signed it")
        }
        AlertDescription::CertificateExpired => {
            Some("it has expired or is not valid yet, or a clock is wrong")
        }
        AlertDescription::BadCertificate
        | AlertDescription::UnsupportedCertificate
        | AlertDescription::CertificateUnknown
        | AlertDescription::CertificateRevoked
        | AlertDescription::AccessDenied => Some("it is not acceptable there"),
        _ => None,
    }
}
