//! Errors of certificates.

use std::path::{Path, PathBuf};

/// A certificate or key that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {fault} (docs/hosts.md, \"Certificates\")", path.display())]
pub struct CertificateError {
    /// The file.
    pub path: PathBuf,
    /// The problem.
    #[source]
    pub fault: CertificateFault,
}

/// Why a certificate or key cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CertificateFault {
    /// The file cannot be read.
    #[error("cannot be read: {0}")]
    Unreadable(std::io::Error),
    /// The file does not contain what is needed.
    #[error("found no {0}, expected one in PEM format, which begins with -----BEGIN")]
    Empty(&'static str),
    /// The content is invalid.
    #[error("damaged: {0}; copy it again, or create a new one with configs/certificates.sh")]
    Damaged(String),
    /// The private key is encrypted.
    #[error(
        "the private key is encrypted, expected one without a passphrase: openssl pkey -in FILE -out FILE removes it"
    )]
    Encrypted,
    /// The private key belongs to another certificate.
    #[error("the private key does not belong to {}; copy both from the same directory created by configs/certificates.sh", certificate.display())]
    OtherKey {
        /// The certificate.
        certificate: PathBuf,
    },
    /// The certificate is signed by another authority.
    #[error("the certificate is not signed by the authority in {}; copy both from the same directory created by configs/certificates.sh", authority.display())]
    OtherAuthority {
        /// The authority.
        authority: PathBuf,
    },
    /// The certificate has expired.
    #[error(
        "the certificate expired on {on}; create a new one with configs/certificates.sh, or correct this host's clock"
    )]
    Expired {
        /// Its last day.
        on: String,
    },
    /// The certificate is not yet valid.
    #[error("the certificate is valid only from {from}; this host's clock may be wrong")]
    NotYet {
        /// Its first day.
        from: String,
    },
    /// The orchestrator's certificate has no host names.
    #[error(
        "the certificate has no host names (subjectAltName), so no agent can connect; create one with configs/certificates.sh"
    )]
    NoNames,
    /// The orchestrator's certificate is for other hosts.
    #[error(
        "the certificate is for {names}, but agents connect to {host}; create one for this name with configs/certificates.sh, or set the host name with --host"
    )]
    OtherNames {
        /// The names in the certificate.
        names: String,
        /// The missing name.
        host: String,
    },
    /// The certificate is for another purpose.
    #[error("the certificate is for another purpose: expected {0} among its extended key usages")]
    Purpose(&'static str),
    /// The other side will reject the certificate for another reason.
    #[error("the other side will reject the certificate: {0}")]
    Refused(String),
}

impl CertificateFault {
    /// The error for this file.
    pub fn at(self, path: &Path) -> CertificateError {
        CertificateError { path: path.to_owned(), fault: self }
    }
}
