//! Protects connections to a server: TLS, unless the traffic stays on this host. The terms are those of libpq,
//! without the modes that protect a connection only if the server offers it.

use std::fs::File;
use std::net::IpAddr;

use sqlx::postgres::{PgConnectOptions, PgSslMode};

/// The URL parameter and the environment variable that select the protection.
const MODE: &str = "sslmode";
const ROOT: (&str, &str) = ("sslrootcert", "PGSSLROOTCERT");
const MODES: &str = "disable, require or verify-full";

/// Refuses parameters that have another meaning here than in libpq, and unreadable files: later, these would look
/// like an unreachable server.
pub fn check_parameters(url: &str) -> Result<(), String> {
    let parameters = url.split_once('?').unwrap_or_default().1;
    let (mut mode, mut has_root) = (std::env::var("PGSSLMODE").ok(), std::env::var_os(ROOT.1).is_some());
    for (key, value) in form_urlencoded::parse(parameters.as_bytes()) {
        match &*key {
            MODE => mode = Some(value.into_owned()),
            "sslrootcert" | "sslcert" | "sslkey" => {
                has_root |= key == ROOT.0;
                File::open(&*value).map_err(|error| format!("cannot read its {key} '{value}' ({error})"))?;
            }
            "ssl-mode" | "ssl-root-cert" | "ssl-ca" | "ssl-cert" | "ssl-key" => {
                return Err(format!(
                    "unknown parameter '{key}': use the names of libpq, {MODE}, sslrootcert, sslcert and sslkey"
                ));
            }
            _ => {}
        }
    }
    match mode.as_deref() {
        Some("require") if has_root => Err(format!(
            "{MODE}=require does not verify the server's certificate, so sslrootcert would have no effect: use \
             {MODE}=verify-full"
        )),
        Some("verify-ca") => Err(format!(
            "{MODE}=verify-ca would trust any server with a certificate of a public authority: use {MODE}=verify-full"
        )),
        None | Some("disable" | "allow" | "prefer" | "require" | "verify-full") => Ok(()),
        Some(mode) => Err(format!("unknown {MODE}={mode}, expected {MODES}")),
    }
}

/// Returns the options, and whether a connection leaves this host unprotected because the user asks for it. Without
/// such a request an unprotected connection is an error.
pub fn resolve(options: PgConnectOptions) -> Result<(PgConnectOptions, bool), String> {
    let by_default = matches!(options.get_ssl_mode(), PgSslMode::Allow | PgSslMode::Prefer);
    match (is_local(&options), by_default) {
        // Within a host, TLS costs time and protects nothing.
        (true, true) => Ok((options.ssl_mode(PgSslMode::Disable), false)),
        (true, false) => Ok((options, false)),
        (false, false) => {
            let unprotected = matches!(options.get_ssl_mode(), PgSslMode::Disable);
            Ok((options, unprotected))
        }
        (false, true) => Err(format!(
            "the server '{}' is another host, so the connection must be protected: add {MODE}=verify-full, and \
             sslrootcert=FILE with the authority that signed the server's certificate unless that is a public one \
             ({MODE}=require encrypts without verifying the server; {MODE}=disable is for a private network)",
            options.get_host()
        )),
    }
}

/// A Unix socket, or a loopback address of this host.
fn is_local(options: &PgConnectOptions) -> bool {
    let host = options.get_host().trim_matches(['[', ']']);
    options.get_socket().is_some()
        || host.starts_with('/')
        || host.eq_ignore_ascii_case("localhost")
        || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use crate::{Location, StoreError};

    fn unprotected(url: &str) -> Result<bool, String> {
        match url.parse::<Location>() {
            Ok(Location::Server(server)) => Ok(server.is_unprotected()),
            Ok(Location::Directory(directory)) => panic!("{}", directory.display()),
            Err(StoreError::Url { reason, .. }) => Err(reason),
            Err(error) => panic!("{error}"),
        }
    }

    #[test]
    fn connections_to_other_hosts_must_be_protected() {
        for local in ["localhost", "127.0.0.1", "127.8.0.1:5433", "[::1]:5433", "%2Frun%2Fpostgresql"] {
            assert_eq!(unprotected(&format!("postgres://anna@{local}/lab")), Ok(false), "{local}");
        }
        assert_eq!(unprotected("postgres:///lab?host=/run/postgresql"), Ok(false));
        for remote in ["head", "192.168.1.7", "[fe80::1]:5433", "localhost.example.org"] {
            let url = format!("postgres://anna@{remote}/lab?schema=x");
            for (mode, expected) in [("require", false), ("verify-full", false), ("disable", true)] {
                assert_eq!(unprotected(&format!("{url}&sslmode={mode}")), Ok(expected), "{remote} {mode}");
            }
            for mode in ["", "&sslmode=prefer", "&sslmode=allow"] {
                let message = unprotected(&format!("{url}{mode}")).unwrap_err();
                assert!(message.contains("sslmode=verify-full"), "{message}");
            }
        }
        // The last value counts.
        assert!(unprotected("postgres://anna@localhost/lab?host=head").is_err());
    }

    #[test]
    fn misleading_parameters_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("an authority.pem");
        std::fs::write(&root, "certificate").unwrap();
        let root = root.to_str().unwrap().replace(' ', "%20");
        let url = |parameters: &str| unprotected(&format!("postgres://anna@head/lab?{parameters}"));
        assert_eq!(url(&format!("sslmode=verify-full&sslrootcert={root}")), Ok(false));
        for (parameters, expected) in [
            (format!("sslmode=require&sslrootcert={root}"), "use sslmode=verify-full"),
            (format!("sslmode=verify-ca&sslrootcert={root}"), "any server with a certificate"),
            (format!("sslmode=verify-full&sslrootcert={root}.old"), "an authority.pem.old' (No such file"),
            ("sslmode=verify-full&sslkey=/nowhere/key.pem".into(), "its sslkey '/nowhere/key.pem'"),
            ("sslmode=verify_full".into(), "unknown sslmode=verify_full"),
            ("ssl-mode=disable".into(), "use the names of libpq"),
        ] {
            let message = url(&parameters).unwrap_err();
            assert!(message.contains(expected), "{message}");
        }
    }
}
