//! Checks requests. Any web page in a browser on this host can reach a loopback address, under whatever name DNS
//! resolves to it. Such requests carry that name, so other names are refused.

use std::net::IpAddr;

use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

/// Passes requests that name this host as itself, and refuses others.
pub async fn require_local_host(request: Request, next: Next) -> Response {
    match host(request.headers()) {
        Some(host) if is_local_host(host) => next.run(request).await,
        _ => (StatusCode::FORBIDDEN, "use localhost or 127.0.0.1: other host names are refused\n")
            .into_response(),
    }
}

/// Content security policy of every response: load from this origin only, and forbid embedding.
const ALLOWED: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
                       base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Adds headers that isolate the responses from other sites.
pub async fn add_security_headers(mut answer: Response) -> Response {
    let said = [
        (header::CONTENT_SECURITY_POLICY, ALLOWED),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ];
    for (name, value) in said {
        answer.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    // Static files set their own cache policy; data is not cached.
    let hold = answer.headers_mut().entry(header::CACHE_CONTROL);
    hold.or_insert(HeaderValue::from_static("no-store"));
    answer
}

/// Whether the request comes from our own page or from no page, according to the browser's headers.
pub fn is_same_origin(headers: &HeaderMap) -> bool {
    let text = |name: HeaderName| headers.get(name).map(|value| value.to_str().unwrap_or_default());
    let site = text(HeaderName::from_static("sec-fetch-site"));
    let origin = text(header::ORIGIN);
    let ours = host(headers).map(|host| format!("http://{host}"));
    site.is_none_or(|site| site == "same-origin")
        && origin.is_none_or(|origin| Some(origin) == ours.as_deref())
}

/// Host name in the request, with the port.
pub fn host(headers: &HeaderMap) -> Option<&str> {
    headers.get(header::HOST)?.to_str().ok()
}

/// Any port is allowed, since ssh may forward another one.
fn is_local_host(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.parse::<u16>().is_ok() => name,
        _ => host,
    };
    let address = name.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(name);
    address.eq_ignore_ascii_case("localhost") || address.parse().is_ok_and(|ip: IpAddr| ip.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_of_other_sites_are_recognized() {
        let of_this_site = |said: &[(&'static str, &'static str)]| {
            let headers = said
                .iter()
                .map(|(name, value)| (HeaderName::from_static(name), HeaderValue::from_static(value)));
            is_same_origin(&headers.collect())
        };
        let host = ("host", "localhost:80");
        assert!(of_this_site(&[host]));
        assert!(of_this_site(&[host, ("origin", "http://localhost:80"), ("sec-fetch-site", "same-origin")]));
        assert!(!of_this_site(&[host, ("origin", "http://example.org")]));
        assert!(!of_this_site(&[host, ("origin", "http://localhost:81")]));
        assert!(!of_this_site(&[host, ("origin", "null")]));
        assert!(!of_this_site(&[host, ("sec-fetch-site", "cross-site")]));
        assert!(!of_this_site(&[("origin", "http://localhost:80")]));
    }

    #[test]
    fn this_host_has_few_names() {
        for host in ["localhost", "LocalHost:80", "127.0.0.1:9464", "127.3.2.1", "[::1]:9464", "[::1]"] {
            assert!(is_local_host(host), "{host}");
        }
        for host in
            ["", "example.org", "127.0.0.1.example.org", "localhost.example.org:80", "10.0.0.1", "[fe80::1]"]
        {
            assert!(!is_local_host(host), "{host}");
        }
    }
}
