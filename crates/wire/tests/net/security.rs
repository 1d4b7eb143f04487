//! Unexpected senders are rejected.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use rcgen::{BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair};
use tokio::time::timeout;
use wire::net::{AgentBootstrap, AgentClient, AgentEvent, AgentServer, NetError, Tls};

use super::test_server::{AGENT_TIMEOUT, LIMIT, ServerOptions, TestServer, agent, endpoint, join};

#[tokio::test(flavor = "multi_thread")]
async fn nothing_listens_or_connects_off_loopback_without_certificates() {
    let endpoint = "tcp/0.0.0.0:7447".parse().unwrap();
    let refused = AgentServer::open(&endpoint, None, 1, AGENT_TIMEOUT, AgentBootstrap::default()).await.err();
    assert!(matches!(refused, Some(NetError::Unprotected { .. })), "{refused:?}");
    let endpoint = "tcp/head:7447".parse().unwrap();
    let refused = AgentClient::open(&endpoint, None, agent("a", 1), |_| {}).await.err();
    assert!(matches!(refused, Some(NetError::Unprotected { .. })), "{refused:?}");
    let tls = Tls::from_directory(Path::new("/nowhere"));
    let refused = AgentClient::open(&endpoint, Some(&tls), agent("a", 1), |_| {}).await.err();
    assert!(refused.unwrap().to_string().contains("/nowhere/authority.pem"));
}

/// Any other message with the orchestrator's key is rejected, and answered with the reason.
#[tokio::test(flavor = "multi_thread")]
async fn unexpected_messages_are_rejected_and_reported() {
    let server = TestServer::open(ServerOptions::default()).await;
    let (_client, membership) = join(server.port, agent("a", 1)).await;
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[\"{}\"]", endpoint(server.port))),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    let outsider = zenoh::open(config).await.unwrap();
    let ask = async |payload: Vec<u8>| {
        let replies = outsider.get("calmwalk/orchestrator").payload(payload).await.unwrap();
        let reply = timeout(LIMIT, replies.recv_async()).await.expect("in time").unwrap();
        String::from_utf8_lossy(&reply.result().unwrap().payload().to_bytes()).into_owned()
    };
    let other_version = [&9_u64.to_le_bytes()[..], b"CALM\x09\0\0\0\0\0\0\0\0\0\0\0"].concat();
    let damaged = [&9_u64.to_le_bytes()[..], b"CALM\x06\0\0\0\x01\0\0\0\0\0\0\0"].concat();
    let cases = [
        (Vec::new(), "request too short: 0 bytes"),
        (vec![1, 2, 3], "the length field alone has 8"),
        (vec![0xff; 64], "but its control message should have 18446744073709551615"),
        (other_version, "control message of version 9, expected version"),
        (damaged, "checksum"),
    ];
    for (payload, expected) in cases {
        let said = ask(payload).await;
        assert!(said.contains(expected), "{said:?}: {expected}");
        let spoken =
            |event: &AgentEvent| matches!(event, AgentEvent::MessageRejected(why) if why.contains(expected));
        server.event(spoken).await;
    }
    membership.leave().await;
    server.close().await;
}

/// An authority, and a directory with a signed certificate for each name.
fn certificates(directory: &Path, names: &[&str]) {
    let authority_key = KeyPair::generate().unwrap();
    let mut authority = CertificateParams::default();
    authority.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let authority_certificate = authority.self_signed(&authority_key).unwrap();
    let issuer = Issuer::new(authority, authority_key);
    for name in names {
        let key = KeyPair::generate().unwrap();
        let mut own = CertificateParams::new([(*name).to_owned()]).unwrap();
        own.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        let own = own.signed_by(&key, &issuer).unwrap();
        let directory = directory.join(name);
        std::fs::create_dir(&directory).unwrap();
        for (file, text) in [
            ("authority.pem", authority_certificate.pem()),
            ("certificate.pem", own.pem()),
            ("key.pem", key.serialize_pem()),
        ] {
            std::fs::write(directory.join(file), text).unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn only_agents_with_a_valid_certificate_can_join() {
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    certificates(folders[0].path(), &["localhost", "node1"]);
    certificates(folders[1].path(), &["localhost"]);
    let tls = |folder: usize, name: &str| Tls::from_directory(&folders[folder].path().join(name));
    let server =
        TestServer::open(ServerOptions { tls: Some(tls(0, "localhost")), ..ServerOptions::default() }).await;
    let endpoint = format!("tcp/localhost:{}", server.port).parse().unwrap();
    let join = async |tls: Option<Tls>, agent_timeout: Duration| {
        let opening = AgentClient::open(&endpoint, tls.as_ref(), agent("a", 1), |_| {});
        let client = timeout(agent_timeout, opening).await.ok()?;
        let client = Arc::new(client.ok()?);
        let membership = timeout(agent_timeout, client.join()).await.ok()?;
        Some((client, membership.unwrap()))
    };
    let a_while = Duration::from_secs(4);
    assert!(join(None, a_while).await.is_none(), "no certificate");
    assert!(join(Some(tls(1, "localhost")), a_while).await.is_none(), "one of another authority");
    let (_client, membership) = join(Some(tls(0, "node1")), LIMIT).await.expect("one of this authority");
    membership.leave().await;
    server.close().await;
}
