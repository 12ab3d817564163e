//! Who may use the page: whoever knows the token in its address, from a page of this address alone.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

/// Scripts, styles and data come from this address, and nothing frames the page.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
                      connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";

/// Reports have their styles and pictures inside them, and never a script.
pub(super) const OF_REPORTS: (HeaderName, &str) = (
    header::CONTENT_SECURITY_POLICY,
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'; sandbox",
);

pub(super) struct Guard {
    pub token: String,
    pub port: u16,
}

impl Guard {
    /// Why a request is refused; `None` if it is not.
    fn refusal(&self, path: &str, headers: &HeaderMap) -> Option<&'static str> {
        // Browsers leave out the port of HTTP.
        let port = if self.port == 80 { String::new() } else { format!(":{}", self.port) };
        let hosts = ["127.0.0.1", "localhost"].map(|name| format!("{name}{port}"));
        // A name that another server resolves to this machine (DNS rebinding) is not this address.
        let is_known = |host: &HeaderValue| hosts.iter().any(|known| known.as_bytes() == host.as_bytes());
        let mut asked = headers.get_all(header::HOST).iter();
        if !asked.next().is_some_and(is_known) || !asked.all(is_known) {
            return Some("open the page at the address that `raysweep view` printed");
        }
        let token = path.trim_start_matches('/').split('/').next().unwrap_or_default();
        if !is_equal(token.as_bytes(), self.token.as_bytes()) {
            return Some("the address lacks the token that `raysweep view` printed");
        }
        let is_foreign = headers
            .get_all(header::ORIGIN)
            .iter()
            .any(|origin| !hosts.iter().any(|host| origin.as_bytes() == format!("http://{host}").as_bytes()));
        (is_foreign || is_embedded(headers)).then_some("pages of other addresses may not use this one")
    }
}

/// Whether a page of another address asks, as browsers say also where they state no origin. A link to the page, which a
/// user follows, is none.
fn is_embedded(headers: &HeaderMap) -> bool {
    let says = |name: &str, value: &str| headers.get_all(name).iter().any(|said| said == value);
    let is_link = says("sec-fetch-mode", "navigate") && says("sec-fetch-dest", "document");
    (says("sec-fetch-site", "cross-site") || says("sec-fetch-site", "same-site")) && !is_link
}

/// Compares in a time that does not depend on where they differ.
fn is_equal(one: &[u8], other: &[u8]) -> bool {
    one.len() == other.len() && one.iter().zip(other).fold(0, |differs, (a, b)| differs | (a ^ b)) == 0
}

/// Lets a request through, or refuses it.
pub(super) async fn admit(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let mut answer = match guard.refusal(request.uri().path(), request.headers()) {
        // Whoever is refused does not keep a connection, of which there are few.
        Some(why) => (StatusCode::FORBIDDEN, [(header::CONNECTION, "close")], why).into_response(),
        None => next.run(request).await,
    };
    let headers = answer.headers_mut();
    headers.entry(header::CONTENT_SECURITY_POLICY).or_insert(HeaderValue::from_static(POLICY));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    headers.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    answer
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_this_address_with_its_token_and_its_own_pages_are_let_in() {
        let guard = Guard { token: "0123abcd".into(), port: 8000 };
        let refusal = |path: &str, host: &str, origin: Option<&str>| {
            let mut headers = HeaderMap::new();
            headers.insert(header::HOST, host.parse().unwrap());
            if let Some(origin) = origin {
                headers.insert(header::ORIGIN, origin.parse().unwrap());
            }
            guard.refusal(path, &headers)
        };
        assert_eq!(refusal("/0123abcd/", "127.0.0.1:8000", None), None);
        assert_eq!(refusal("/0123abcd/call", "localhost:8000", Some("http://localhost:8000")), None);
        for (path, host, origin) in [
            ("/", "127.0.0.1:8000", None),
            ("/0123abce/", "127.0.0.1:8000", None),
            ("/0123abcd0/", "127.0.0.1:8000", None),
            ("/0123abcd/", "127.0.0.1:8001", None),
            ("/0123abcd/", "rig.example.org:8000", None),
            ("/0123abcd/", "", None),
            ("/0123abcd/call", "127.0.0.1:8000", Some("http://example.org")),
            ("/0123abcd/call", "127.0.0.1:8000", Some("null")),
            ("/0123abcd/call", "127.0.0.1:8000", Some("https://127.0.0.1:8000")),
        ] {
            assert!(refusal(path, host, origin).is_some(), "{path} {host} {origin:?}");
        }
        let two = ["127.0.0.1:8000", "example.org"].map(|host| (header::HOST, host.parse().unwrap()));
        let mut headers = HeaderMap::new();
        for (name, host) in two {
            headers.append(name, host);
        }
        assert!(guard.refusal("/0123abcd/", &headers).is_some(), "two hosts");
    }

    #[test]
    fn what_other_pages_embed_is_refused_and_a_link_is_not() {
        let guard = Guard { token: "0123abcd".into(), port: 8000 };
        for (site, mode, dest, is_let_in) in [
            ("same-origin", "cors", "empty", true),
            ("none", "navigate", "document", true),
            ("cross-site", "navigate", "document", true),
            ("cross-site", "navigate", "iframe", false),
            ("cross-site", "no-cors", "image", false),
            ("same-site", "no-cors", "script", false),
        ] {
            let mut headers = HeaderMap::new();
            headers.insert(header::HOST, "127.0.0.1:8000".parse().unwrap());
            for (name, value) in
                [("sec-fetch-site", site), ("sec-fetch-mode", mode), ("sec-fetch-dest", dest)]
            {
                headers.insert(name, value.parse().unwrap());
            }
            let refusal = guard.refusal("/0123abcd/pictures/epipolar", &headers);
            assert_eq!(refusal.is_none(), is_let_in, "{site} {mode} {dest}");
        }
    }
}
