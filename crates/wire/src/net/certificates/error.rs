//! What can be wrong with certificates.

use std::path::{Path, PathBuf};

/// A certificate or key that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {fault} (docs/hosts.md, \"Certificates\")", path.display())]
pub struct CertificateError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    #[source]
    pub fault: CertificateFault,
}

/// What is wrong with a certificate or key.
#[derive(Debug, thiserror::Error)]
pub enum CertificateFault {
    /// The file cannot be read.
    #[error("cannot be read: {0}")]
    Unreadable(std::io::Error),
    /// The file has nothing of what is needed.
    #[error("found no {0}, expected one in PEM format, which begins with -----BEGIN")]
    Empty(&'static str),
    /// It is there and makes no sense.
    #[error("damaged: {0}; copy it anew, or make another with configs/certificates.sh")]
    Damaged(String),
    /// A private key that takes a passphrase.
    #[error(
        "the private key is encrypted, expected one without a passphrase: openssl pkey -in FILE -out FILE removes it"
    )]
    Encrypted,
    /// A private key that belongs to another certificate.
    #[error("the private key is not that of {}; copy both from one directory that configs/certificates.sh has made", certificate.display())]
    OtherKey {
        /// The certificate.
        certificate: PathBuf,
    },
    /// A certificate that another authority has signed.
    #[error("the certificate was not signed by the authority in {}; copy both from one directory that configs/certificates.sh has made", authority.display())]
    OtherAuthority {
        /// The authority.
        authority: PathBuf,
    },
    /// A certificate that has expired.
    #[error(
        "the certificate expired on {on}; make another with configs/certificates.sh, or put this host's clock right"
    )]
    Expired {
        /// The last day of it.
        on: String,
    },
    /// A certificate that is not in force yet.
    #[error("the certificate is valid from {from} on; this host's clock may be wrong")]
    NotYet {
        /// The first day of it.
        from: String,
    },
    /// A certificate of an orchestrator that names no host.
    #[error(
        "the certificate names no host (subjectAltName), so that no agent can connect; configs/certificates.sh makes one that does"
    )]
    NoNames,
    /// A certificate of an orchestrator that names other hosts.
    #[error(
        "the certificate is for {names}, and agents are told to connect to {host}; make one for this name with configs/certificates.sh, or name the host with --host"
    )]
    OtherNames {
        /// The names that it has.
        names: String,
        /// The name that it lacks.
        host: String,
    },
    /// A certificate for something else.
    #[error("the certificate is not meant for this use: expected {0} among its extended key usages")]
    Purpose(&'static str),
    /// Something else that the other side will not accept.
    #[error("the other side will refuse the certificate: {0}")]
    Refused(String),
}

impl CertificateFault {
    /// The fault of a file.
    pub fn at(self, path: &Path) -> CertificateError {
        CertificateError { path: path.to_owned(), fault: self }
    }
}
