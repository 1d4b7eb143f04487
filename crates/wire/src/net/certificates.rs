//! Validation of certificates before listening or connecting. zenoh reports an invalid certificate only as a failed
//! connection.

mod error;
#[cfg(test)]
mod tests;

use std::fs;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use rustls::client::WebPkiServerVerifier;
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::server::WebPkiClientVerifier;
use rustls::sign::CertifiedKey;
use rustls::{CertificateError as Refusal, InconsistentKeys, RootCertStore};
use x509_parser::certificate::X509Certificate;
use x509_parser::extensions::GeneralName;
use x509_parser::prelude::FromDer;
use x509_parser::time::ASN1Time;

pub use self::error::{CertificateError, CertificateFault};
use super::side::ConnectionSide;

/// Warn about certificates that expire within this time.
const EXPIRY_WARNING: Duration = Duration::from_secs(14 * 24 * 3600);

/// Certificates as PEM files. Both sides present a certificate, and each trusts those signed by the authority.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tls {
    /// Certificate of the authority.
    pub authority: PathBuf,
    /// Certificate of this host.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

/// Result of a successful validation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckedTls {
    /// Host names and addresses in the certificate of this host.
    pub names: Vec<String>,
    /// Warnings about upcoming problems, one sentence each.
    pub warnings: Vec<String>,
}

/// Content of the three files.
pub(super) struct Credentials {
    /// The authority.
    pub roots: Arc<RootCertStore>,
    /// The certificate of this host, then the intermediate certificates.
    pub chain: Vec<CertificateDer<'static>>,
    /// The private key of this host's certificate.
    pub key: PrivateKeyDer<'static>,
}

impl Tls {
    /// Uses `authority.pem`, `certificate.pem` and `key.pem` in a directory.
    pub fn from_directory(directory: &Path) -> Self {
        let [authority, certificate, key] =
            ["authority.pem", "certificate.pem", "key.pem"].map(|name| directory.join(name));
        Self { authority, certificate, key }
    }

    /// Checks that an orchestrator can listen with these certificates, so that agents can connect to one of the names.
    ///
    /// # Errors
    /// See [`Self::check_for_agent`]; also a certificate without names.
    pub fn check_for_orchestrator(&self) -> Result<CheckedTls, CertificateError> {
        self.check(ConnectionSide::Orchestrator, SystemTime::now())
    }

    /// Checks that an agent can connect with these certificates.
    ///
    /// # Errors
    /// A file that cannot be read or is damaged, a certificate that is not currently valid or not signed by the
    /// authority, or a key that belongs to another certificate.
    pub fn check_for_agent(&self) -> Result<CheckedTls, CertificateError> {
        self.check(ConnectionSide::Agent, SystemTime::now())
    }

    pub(super) fn check(
        &self,
        side: ConnectionSide,
        now: SystemTime,
    ) -> Result<CheckedTls, CertificateError> {
        let credentials = self.load()?;
        let mut warnings = Vec::new();
        for (path, certificates) in [
            (&self.authority, certificates(&self.authority)?),
            (&self.certificate, credentials.chain.clone()),
        ] {
            for certificate in &certificates {
                let parsed = parse(path, certificate)?;
                warnings.extend(
                    check_validity(&parsed, now)
                        .map_err(|fault| fault.at(path))?
                        .map(|warning| format!("{} {warning}", path.display())),
                );
            }
        }
        let own = credentials
            .chain
            .first()
            .ok_or_else(|| CertificateFault::Empty("certificate").at(&self.certificate))?;
        let names = names(&parse(&self.certificate, own)?);
        self.check_accepted(&credentials, side, &names, now)?;
        Ok(CheckedTls { names, warnings })
    }

    /// Reads the files.
    pub(super) fn load(&self) -> Result<Credentials, CertificateError> {
        let mut roots = RootCertStore::empty();
        for certificate in certificates(&self.authority)? {
            let added = roots.add(certificate);
            added.map_err(|why| CertificateFault::Damaged(why.to_string()).at(&self.authority))?;
        }
        let chain = certificates(&self.certificate)?;
        let key = private_key(&self.key)?;
        match CertifiedKey::from_der(chain.clone(), key.clone_key(), &provider()) {
            Ok(_) => Ok(Credentials { roots: Arc::new(roots), chain, key }),
            Err(rustls::Error::InconsistentKeys(InconsistentKeys::KeyMismatch)) => {
                Err(CertificateFault::OtherKey { certificate: self.certificate.clone() }.at(&self.key))
            }
            Err(rustls::Error::InvalidCertificate(why)) => {
                Err(CertificateFault::Damaged(why.to_string()).at(&self.certificate))
            }
            Err(why) => Err(CertificateFault::Damaged(why.to_string()).at(&self.key)),
        }
    }

    /// Validates this host's certificate as the other side will.
    fn check_accepted(
        &self,
        credentials: &Credentials,
        side: ConnectionSide,
        names: &[String],
        now: SystemTime,
    ) -> Result<(), CertificateError> {
        let Some((own, between)) = credentials.chain.split_first() else { return Ok(()) };
        let roots = Arc::clone(&credentials.roots);
        let now = UnixTime::since_unix_epoch(now.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default());
        let provider = Arc::new(provider());
        let fault = |why: String| CertificateFault::Damaged(why).at(&self.authority);
        let accepted = match side {
            ConnectionSide::Orchestrator => {
                // Any name matches a wildcard.
                let name = names.iter().find_map(|name| ServerName::try_from(name.replace('*', "host")).ok());
                let name = name.ok_or_else(|| CertificateFault::NoNames.at(&self.certificate))?;
                let verifier = WebPkiServerVerifier::builder_with_provider(roots, provider).build();
                let verifier = verifier.map_err(|why| fault(why.to_string()))?;
                rustls::client::danger::ServerCertVerifier::verify_server_cert(
                    &*verifier,
                    own,
                    between,
                    &name,
                    &[],
                    now,
                )
                .map(drop)
            }
            ConnectionSide::Agent => {
                let verifier = WebPkiClientVerifier::builder_with_provider(roots, provider).build();
                let verifier = verifier.map_err(|why| fault(why.to_string()))?;
                verifier.verify_client_cert(own, between, now).map(drop)
            }
        };
        accepted.map_err(|why| match why {
            rustls::Error::InvalidCertificate(Refusal::UnknownIssuer | Refusal::BadSignature) => {
                CertificateFault::OtherAuthority { authority: self.authority.clone() }.at(&self.certificate)
            }
            rustls::Error::InvalidCertificate(
                Refusal::InvalidPurpose | Refusal::InvalidPurposeContext { .. },
            ) => CertificateFault::Purpose(purpose(side)).at(&self.certificate),
            why => CertificateFault::Refused(why.to_string()).at(&self.certificate),
        })
    }
}

impl CheckedTls {
    /// Whether agents can use this name for the host: it is in the certificate, possibly with a wildcard for the first
    /// label.
    pub fn is_valid_for(&self, host: &str) -> bool {
        let address = |text: &str| text.parse::<IpAddr>().ok();
        let host = host.trim_start_matches('[').trim_end_matches(']');
        self.names.iter().any(|name| match name.strip_prefix("*.") {
            Some(domain) => host.split_once('.').is_some_and(|(_, of)| of.eq_ignore_ascii_case(domain)),
            None if address(host).is_some() => address(name) == address(host),
            None => name.eq_ignore_ascii_case(host),
        })
    }
}

/// The same cryptography provider as zenoh's.
pub(super) fn provider() -> CryptoProvider {
    ring::default_provider()
}

fn read(path: &Path) -> Result<Vec<u8>, CertificateError> {
    fs::read(path).map_err(|source| CertificateFault::Unreadable(source).at(path))
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, CertificateError> {
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&read(path)?).collect();
    let found = found.map_err(|why| CertificateFault::Damaged(why.to_string()).at(path))?;
    if found.is_empty() { Err(CertificateFault::Empty("certificate").at(path)) } else { Ok(found) }
}

fn private_key(path: &Path) -> Result<PrivateKeyDer<'static>, CertificateError> {
    let text = read(path)?;
    PrivateKeyDer::from_pem_slice(&text).map_err(|why| {
        let is_encrypted = text.windows(9).any(|part| part == b"ENCRYPTED");
        let fault = match why {
            _ if is_encrypted => CertificateFault::Encrypted,
            rustls::pki_types::pem::Error::NoItemsFound => CertificateFault::Empty("private key"),
            why => CertificateFault::Damaged(why.to_string()),
        };
        fault.at(path)
    })
}

fn parse<'a>(
    path: &Path,
    certificate: &'a CertificateDer<'_>,
) -> Result<X509Certificate<'a>, CertificateError> {
    let parsed = X509Certificate::from_der(certificate);
    parsed.map(|(_, parsed)| parsed).map_err(|why| CertificateFault::Damaged(why.to_string()).at(path))
}

/// Checks the validity period; returns a warning if the certificate expires soon.
fn check_validity(
    certificate: &X509Certificate<'_>,
    now: SystemTime,
) -> Result<Option<String>, CertificateFault> {
    let since = now.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let now = i64::try_from(since.as_secs()).unwrap_or(i64::MAX);
    let date = |time: ASN1Time| time.to_datetime().date().to_string();
    let validity = certificate.validity();
    let left = validity.not_after.timestamp().saturating_sub(now);
    if now < validity.not_before.timestamp() {
        Err(CertificateFault::NotYet { from: date(validity.not_before) })
    } else if left < 0 {
        Err(CertificateFault::Expired { on: date(validity.not_after) })
    } else if left < EXPIRY_WARNING.as_secs().cast_signed() {
        let days = left / (24 * 3600);
        Ok(Some(format!("expires on {}, in {days} days: renew it in time", date(validity.not_after))))
    } else {
        Ok(None)
    }
}

/// Host names and addresses of a certificate.
fn names(certificate: &X509Certificate<'_>) -> Vec<String> {
    let names = certificate.subject_alternative_name().ok().flatten();
    let names = names.iter().flat_map(|names| &names.value.general_names);
    let text = |name: &GeneralName<'_>| match name {
        GeneralName::DNSName(name) => Some((*name).to_owned()),
        GeneralName::IPAddress(bytes) => match *bytes {
            [a, b, c, d] => Some(IpAddr::from([*a, *b, *c, *d]).to_string()),
            bytes => <[u8; 16]>::try_from(bytes).ok().map(|bytes| IpAddr::from(bytes).to_string()),
        },
        _ => None,
    };
    names.filter_map(text).collect()
}

fn purpose(side: ConnectionSide) -> &'static str {
    match side {
        ConnectionSide::Orchestrator => "serverAuth",
        ConnectionSide::Agent => "clientAuth",
    }
}
