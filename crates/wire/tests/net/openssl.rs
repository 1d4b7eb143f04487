//! The script that creates certificates, which requires openssl: `cargo test -p wire --test openssl`.

#[allow(dead_code, reason = "this target uses a part")]
mod test_server;

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use test_server::{LIMIT, ServerOptions, TestServer, agent};
use tokio::time::timeout;
use wire::net::{AgentClient, Tls};

fn make(directory: &Path, names: &[&str]) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/certificates.sh");
    let made = Command::new("sh").arg(script).arg(directory).args(names).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
}

#[tokio::test(flavor = "multi_thread")]
async fn hosts_with_certificates_of_the_script_can_connect() {
    let directory = tempfile::tempdir().unwrap();
    make(directory.path(), &["head=node.example,localhost,10.0.0.8"]);
    // Another host later.
    make(directory.path(), &["10.0.0.7"]);
    let tls = |name: &str| Tls::from_directory(&directory.path().join(name));
    let server = TestServer::open(ServerOptions { tls: Some(tls("head")), ..ServerOptions::default() }).await;
    let endpoint = format!("tcp/localhost:{}", server.port).parse().unwrap();
    let other = tls("10.0.0.7");
    let client = AgentClient::open(&endpoint, Some(&other), agent("a", 1), |_| {});
    let client = Arc::new(timeout(LIMIT, client).await.expect("in time").unwrap());
    let membership = timeout(LIMIT, client.join()).await.expect("in time").unwrap();
    membership.leave().await;
    server.close().await;
}
