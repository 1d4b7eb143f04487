//! Hosts with wrong certificates: the process that can detect the wrong file names it at once, and no process hangs.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, SystemTime};

use rcgen::{BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair};

use crate::common::campaign::Small;
use crate::common::hosts::Hosts;
use crate::common::processes::{signal, wait_until};
use crate::common::{Running, program, refuse};

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

    /// Creates a directory with a host's certificate, which is valid for `days` from now, or expired that long ago if
    /// negative.
    fn host(&self, directory: PathBuf, name: &str, days: i64) -> PathBuf {
        let key = KeyPair::generate().unwrap();
        let mut own = CertificateParams::new([name.to_owned()]).unwrap();
        own.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        let now = SystemTime::now();
        own.not_before = (now - Duration::from_secs(400 * 24 * 3600)).into();
        let days_long = Duration::from_secs(days.unsigned_abs() * 24 * 3600 + 3600);
        own.not_after = if days < 0 { (now - days_long).into() } else { (now + days_long).into() };
        let own = own.signed_by(&key, &self.issuer).unwrap();
        fs::create_dir_all(&directory).unwrap();
        for (file, text) in [
            ("authority.pem", self.pem.clone()),
            ("certificate.pem", own.pem()),
            ("key.pem", key.serialize_pem()),
        ] {
            fs::write(directory.join(file), text).unwrap();
        }
        directory
    }
}

fn tls(directory: &Path) -> Vec<String> {
    vec![format!("--tls={}", directory.display())]
}

/// A campaign whose orchestrator and agent use these certificates, and connect via `localhost`.
fn hosts(orchestrator: &Path, agent: &Path) -> Hosts {
    // The campaign does not end without a signal.
    let small = Small { mode: "live", steps: 1_000_000, max_per_walk: 1_000_000, ..Small::default() };
    let mut hosts = Hosts::new(&small, 1, "");
    let port = hosts.endpoints[0].rsplit(':').next().unwrap().to_owned();
    hosts.endpoints = [format!("tcp/127.0.0.1:{port}"), format!("tcp/localhost:{port}")];
    hosts.options = [tls(orchestrator), tls(agent)];
    hosts
}

#[test]
fn files_that_are_wrong_end_a_run_and_an_agent_at_once() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    let authority = Authority::new();
    let (expired, missing, other) = (
        authority.host(here.join("expired"), "localhost", -3),
        authority.host(here.join("missing"), "localhost", 300),
        authority.host(here.join("other"), "localhost", 300),
    );
    fs::remove_file(missing.join("key.pem")).unwrap();
    fs::write(other.join("key.pem"), KeyPair::generate().unwrap().serialize_pem()).unwrap();
    let foreign = authority.host(here.join("foreign"), "localhost", 300);
    fs::write(foreign.join("authority.pem"), Authority::new().pem).unwrap();
    for (directory, file, expected) in [
        (&expired, "certificate.pem", "expired on"),
        (&missing, "key.pem", "cannot be read"),
        (&other, "key.pem", "does not belong to"),
        (&foreign, "certificate.pem", "is not signed by"),
    ] {
        let [tls] = tls(directory).try_into().unwrap();
        let file = directory.join(file).display().to_string();
        for arguments in [
            ["run", "campaign.toml", "--directory=campaign", "--listen=tcp/127.0.0.1:0", &tls],
            ["agent", "--join", "tcp/localhost:1", "--walkers=1", &tls],
        ] {
            let said = refuse(here, arguments);
            assert!(said.contains(&file) && said.contains(expected), "{arguments:?}: {said}");
        }
    }
    assert!(!here.join("campaign/campaign.sqlite").exists(), "nothing was begun");
    // The announced name is not in the certificate.
    let node = authority.host(here.join("node"), "node7", 300);
    let [tls] = tls(&node).try_into().unwrap();
    let arguments =
        ["run", "campaign.toml", "--listen=tcp/0.0.0.0:0", "--announce=endpoint", "--host=head", &tls];
    let said = refuse(here, arguments);
    assert!(said.contains("node7") && said.contains("head") && said.contains("--host"), "{said}");
}

#[test]
fn a_run_warns_of_a_certificate_that_expires_soon() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    let soon = Authority::new().host(here.join("head"), "localhost", 5);
    let mut command = program(here);
    command.args(["run", "campaign.toml", "--listen", "tcp/localhost:0"]).args(tls(&soon));
    let said = here.join("said");
    let _run =
        Running(command.stdout(Stdio::null()).stderr(fs::File::create(&said).unwrap()).spawn().unwrap());
    let said = || fs::read_to_string(&said).unwrap();
    wait_until("the orchestrator listens", || said().contains("agents may join"));
    assert!(said().contains("certificate.pem expires on") && said().contains("in 5 days"), "{}", said());
}

#[test]
fn an_agent_that_cannot_accept_the_orchestrators_certificate_ends_and_says_why() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let authority = Authority::new();
    let agent = authority.host(here.join("agent"), "node1", 300);
    let other_name = authority.host(here.join("other_name"), "head.example", 300);
    let other_authority = Authority::new().host(here.join("other_authority"), "localhost", 300);
    for (orchestrator, expected) in [
        (other_name, "it is for head.example, not for localhost"),
        (other_authority, "it is signed by another authority"),
    ] {
        let mut hosts = hosts(&orchestrator, &agent);
        let log = hosts.home.path().join("log");
        hosts.options[0].push(format!("--log={}", log.display()));
        let mut run = hosts.start_orchestrator();
        wait_until("the orchestrator listens", || hosts.orchestrator_stderr().contains("agents may join"));
        let mut waiting = hosts.agent(0);
        assert_eq!(waiting.0.wait().unwrap().code(), Some(2), "{}", hosts.said(0));
        assert!(hosts.said(0).contains(expected), "{}", hosts.said(0));
        signal(run.0.id(), "TERM");
        assert_eq!(run.0.wait().unwrap().code(), Some(130), "{}", hosts.orchestrator_stderr());
        let log = fs::read_to_string(log).unwrap();
        assert!(log.contains("a connection was refused") && !log.contains("open file limit"), "{log}");
        hosts.assert_cleaned_up();
    }
}

#[test]
fn an_agent_whose_certificate_the_orchestrator_refuses_ends_and_says_why() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let (authority, other) = (Authority::new(), Authority::new());
    let orchestrator = authority.host(here.join("head"), "localhost", 300);
    let agent = other.host(here.join("agent"), "node1", 300);
    // The agent trusts both authorities, but only its own authority signed its certificate.
    fs::write(agent.join("authority.pem"), format!("{}{}", other.pem, authority.pem)).unwrap();
    let hosts = hosts(&orchestrator, &agent);
    let mut run = hosts.start_orchestrator();
    wait_until("the orchestrator listens", || hosts.orchestrator_stderr().contains("agents may join"));
    let mut waiting = hosts.agent(0);
    assert_eq!(waiting.0.wait().unwrap().code(), Some(2), "{}", hosts.said(0));
    let said = hosts.said(0);
    assert!(said.contains("rejects the certificate") && said.contains("another authority"), "{said}");
    signal(run.0.id(), "TERM");
    assert_eq!(run.0.wait().unwrap().code(), Some(130), "{}", hosts.orchestrator_stderr());
    hosts.assert_cleaned_up();
}
