use std::fs;
use std::time::{Duration, SystemTime};

use rcgen::{
    BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose as Purpose, IsCa, Issuer, KeyPair,
    date_time_ymd,
};

use super::*;

const DAY: Duration = Duration::from_secs(24 * 3600);

/// Noon on 2030-06-01.
fn today() -> SystemTime {
    SystemTime::UNIX_EPOCH + Duration::from_secs(1_906_545_600)
}

struct Authority {
    pem: String,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    fn new() -> Self {
        let key = KeyPair::generate().unwrap();
        let mut parameters = CertificateParams::default();
        parameters.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let pem = parameters.self_signed(&key).unwrap().pem();
        Self { pem, issuer: Issuer::new(parameters, key) }
    }

    /// Writes the files of a host, with changes to its certificate.
    fn host(&self, directory: &Path, change: impl FnOnce(&mut CertificateParams)) -> Tls {
        let key = KeyPair::generate().unwrap();
        let mut parameters = CertificateParams::new(["head".to_owned(), "10.0.0.3".to_owned()]).unwrap();
        parameters.extended_key_usages = vec![Purpose::ServerAuth, Purpose::ClientAuth];
        (parameters.not_before, parameters.not_after) =
            (date_time_ymd(2030, 1, 1), date_time_ymd(2031, 1, 1));
        change(&mut parameters);
        let certificate = parameters.signed_by(&key, &self.issuer).unwrap();
        fs::write(directory.join("authority.pem"), &self.pem).unwrap();
        fs::write(directory.join("certificate.pem"), certificate.pem()).unwrap();
        fs::write(directory.join("key.pem"), key.serialize_pem()).unwrap();
        Tls::from_directory(directory)
    }
}

fn refused(tls: &Tls, side: ConnectionSide) -> String {
    tls.check(side, today()).unwrap_err().to_string()
}

#[test]
fn valid_certificates_work_on_both_sides() {
    let directory = tempfile::tempdir().unwrap();
    let tls = Authority::new().host(directory.path(), |_| {});
    for side in [ConnectionSide::Orchestrator, ConnectionSide::Agent] {
        let checked = tls.check(side, today()).unwrap();
        assert_eq!(checked, CheckedTls { names: vec!["head".into(), "10.0.0.3".into()], warnings: vec![] });
    }
}

#[test]
fn certificates_match_their_host_names() {
    let names = ["head", "*.cluster.example", "10.0.0.3", "::1"].map(str::to_owned).to_vec();
    let checked = CheckedTls { names, warnings: vec![] };
    for host in ["head", "HEAD", "node7.cluster.example", "10.0.0.3", "[::1]", "[0:0:0:0:0:0:0:1]"] {
        assert!(checked.is_valid_for(host), "{host}");
    }
    for host in ["node7", "cluster.example", "a.b.cluster.example", "10.0.0.4", "[::2]", ""] {
        assert!(!checked.is_valid_for(host), "{host}");
    }
}

#[test]
fn errors_name_the_file() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let authority = Authority::new();
    let other = KeyPair::generate().unwrap().serialize_pem();
    let no_base64 = "-----BEGIN CERTIFICATE-----\n!!!\n-----END CERTIFICATE-----\n";
    let no_certificate = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n";
    let encrypted = "-----BEGIN ENCRYPTED PRIVATE KEY-----\nAAAA\n-----END ENCRYPTED PRIVATE KEY-----\n";
    for (file, content, expected) in [
        ("authority.pem", None, "cannot be read"),
        ("certificate.pem", None, "cannot be read"),
        ("key.pem", None, "cannot be read"),
        ("authority.pem", Some(""), "found no certificate"),
        ("certificate.pem", Some("Certificate:\n  Data:\n"), "found no certificate"),
        ("certificate.pem", Some(&other), "found no certificate"),
        ("key.pem", Some(""), "found no private key"),
        ("key.pem", Some(&authority.pem), "found no private key"),
        ("key.pem", Some(encrypted), "encrypted"),
        ("key.pem", Some(&other), "does not belong to"),
        ("authority.pem", Some(no_base64), "damaged"),
        ("certificate.pem", Some(no_base64), "damaged"),
        ("authority.pem", Some(no_certificate), "damaged"),
        ("certificate.pem", Some(no_certificate), "damaged"),
    ] {
        let tls = authority.host(here, |_| {});
        match content {
            Some(content) => fs::write(here.join(file), content).unwrap(),
            None => fs::remove_file(here.join(file)).unwrap(),
        }
        for side in [ConnectionSide::Orchestrator, ConnectionSide::Agent] {
            let why = refused(&tls, side);
            let begins = format!("{}: ", here.join(file).display());
            assert!(why.starts_with(&begins) && why.contains(expected), "{file} {expected}: {why}");
        }
    }
}

#[test]
fn certificates_of_other_authorities_or_purposes_are_rejected() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let tls = Authority::new().host(here, |_| {});
    fs::write(&tls.authority, Authority::new().pem).unwrap();
    for side in [ConnectionSide::Orchestrator, ConnectionSide::Agent] {
        let why = refused(&tls, side);
        assert!(why.contains("certificate.pem: the certificate is not signed by"), "{why}");
    }
    let tls = Authority::new().host(here, |certificate| {
        certificate.extended_key_usages = vec![Purpose::ClientAuth];
    });
    assert!(refused(&tls, ConnectionSide::Orchestrator).contains("serverAuth"));
    assert!(tls.check(ConnectionSide::Agent, today()).is_ok());
    let tls = Authority::new().host(here, |certificate| certificate.subject_alt_names.clear());
    assert!(refused(&tls, ConnectionSide::Orchestrator).contains("has no host names"));
    assert!(tls.check(ConnectionSide::Agent, today()).is_ok(), "an agent needs no name");
}

#[test]
fn certificates_are_rejected_outside_their_validity_with_a_warning_before_expiry() {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new();
    let until = |year, month, day| {
        let tls = authority.host(directory.path(), |certificate| {
            certificate.not_after = date_time_ymd(year, month, day);
        });
        tls.check(ConnectionSide::Agent, today())
    };
    assert_eq!(until(2030, 6, 16).unwrap().warnings, [""; 0]);
    let warnings = until(2030, 6, 14).unwrap().warnings;
    assert!(
        warnings.len() == 1 && warnings[0].contains("certificate.pem expires on 2030-06-14"),
        "{warnings:?}"
    );
    let why = until(2030, 5, 31).unwrap_err().to_string();
    assert!(why.contains("certificate.pem: the certificate expired on 2030-05-31"), "{why}");
    let early = authority.host(directory.path(), |_| {}).check(ConnectionSide::Agent, today() - 200 * DAY);
    let why = early.unwrap_err().to_string();
    assert!(why.contains("certificate.pem: the certificate is valid only from 2030-01-01"), "{why}");
}
