//! A GET over a connection that stands. A redirection is not followed: it is an answer, and a good one.

use std::net::SocketAddr;

use bytes::Bytes;
use futures::future::{Either, select};
use http::header::{ACCEPT, CONNECTION, HOST, HeaderName, HeaderValue, USER_AGENT};
use http_body_util::{BodyExt, Empty};
use hyper::client::conn::http1;
use hyper_util::rt::TokioIo;
use muster_api::kind::task::probe::HttpCheck;
use tokio::io::{AsyncRead, AsyncWrite};

use crate::runtime::KEPT_WORDS;

/// The status, and the beginning of what came with it.
pub(super) async fn get(
    stream: impl AsyncRead + AsyncWrite + Unpin,
    at: SocketAddr,
    check: &HttpCheck,
) -> Result<(u16, String), hyper::Error> {
    let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await?;
    let exchange = async {
        let response = sender.send_request(request(at, check)).await?;
        let status = response.status().as_u16();
        let mut body = response.into_body();
        let mut said = Vec::new();
        while said.len() < KEPT_WORDS {
            // The status is the answer; a body that breaks off takes nothing from it.
            let Some(Ok(frame)) = body.frame().await else { break };
            said.extend_from_slice(frame.data_ref().map_or(&[], |data| data));
        }
        said.truncate(KEPT_WORDS);
        Ok((status, String::from_utf8_lossy(&said).into_owned()))
    };
    match select(std::pin::pin!(exchange), std::pin::pin!(connection)).await {
        Either::Left((done, _)) => done,
        // The other end has closed it; what it said is there, or it said nothing.
        Either::Right((_, exchange)) => exchange.await,
    }
}

fn request(at: SocketAddr, check: &HttpCheck) -> http::Request<Empty<Bytes>> {
    let mut request = http::Request::new(Empty::new());
    // Admission lets only through what can be parsed.
    *request.uri_mut() = check.path.parse().unwrap_or_default();
    let headers = request.headers_mut();
    let fixed = |text| HeaderValue::from_static(text);
    headers.insert(USER_AGENT, fixed(concat!("muster-probe/", env!("CARGO_PKG_VERSION"))));
    headers.insert(ACCEPT, fixed("*/*"));
    headers.insert(CONNECTION, fixed("close"));
    if let Ok(host) = HeaderValue::from_str(&at.to_string()) {
        headers.insert(HOST, host);
    }
    for header in &check.headers {
        if let (Ok(name), Ok(value)) =
            (HeaderName::from_bytes(header.name.as_bytes()), HeaderValue::from_str(&header.value))
        {
            headers.insert(name, value);
        }
    }
    request
}
