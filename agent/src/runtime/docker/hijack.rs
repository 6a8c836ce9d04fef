//! Streams of the engine that are HTTP only until they begin: the input and output of a program in a container, and of
//! containers themselves. Frames are passed on in pieces as they come: a length that the engine names is never waited for.

use std::path::Path;

use bytes::{Buf as _, Bytes, BytesMut};
use http::{Method, Request, StatusCode, header};
use http_body_util::{BodyExt as _, Full};
use hyper::upgrade::Upgraded;
use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncReadExt as _, ReadHalf, WriteHalf};
use tokio::net::UnixStream;
use tokio_util::task::AbortOnDropHandle;

use crate::exec::ends::{CHUNK, Gone, Outlet, Stream};

/// Why there is no stream.
#[derive(Debug, thiserror::Error)]
pub(super) enum HijackError {
    #[error("failed to reach the Docker Engine")]
    Connect(#[source] std::io::Error),
    #[error("the Docker Engine does not answer")]
    Http(#[source] hyper::Error),
    #[error("the request is malformed")]
    Request(#[source] http::Error),
    /// The engine says no; its words.
    #[error("{message}")]
    Refused { code: StatusCode, message: String },
}

/// A stream that has begun.
pub(super) struct Hijacked {
    pub(super) output: ReadHalf<TokioIo<Upgraded>>,
    pub(super) input: WriteHalf<TokioIo<Upgraded>>,
    /// Carries the bytes.
    _connection: AbortOnDropHandle<()>,
}

/// POSTs `body` and takes the connection over.
pub(super) async fn hijack(
    socket: &Path,
    path: &str,
    body: String,
) -> Result<Hijacked, HijackError> {
    let stream = UnixStream::connect(socket).await.map_err(HijackError::Connect)?;
    let handshake = hyper::client::conn::http1::handshake(TokioIo::new(stream));
    let (mut sender, connection) = handshake.await.map_err(HijackError::Http)?;
    let connection = tokio::spawn(async move {
        // An error shows at both ends of what it carries.
        let _ = connection.with_upgrades().await;
    });
    let connection = AbortOnDropHandle::new(connection);
    let request = Request::builder()
        .method(Method::POST)
        .uri(path)
        .header(header::HOST, "docker")
        .header(header::CONNECTION, "Upgrade")
        .header(header::UPGRADE, "tcp")
        .header(header::CONTENT_TYPE, "application/json")
        .body(Full::new(Bytes::from(body)))
        .map_err(HijackError::Request)?;
    let mut response = sender.send_request(request).await.map_err(HijackError::Http)?;
    let code = response.status();
    if code != StatusCode::SWITCHING_PROTOCOLS {
        let body = response.body_mut().collect().await.map_err(HijackError::Http)?.to_bytes();
        let said: Option<serde_json::Value> = serde_json::from_slice(&body).ok();
        let message = said.as_ref().and_then(|said| said["message"].as_str());
        let message = message.map_or_else(|| format!("the engine answers {code}"), str::to_owned);
        return Err(HijackError::Refused { code, message });
    }
    let upgraded = hyper::upgrade::on(response).await.map_err(HijackError::Http)?;
    let (output, input) = tokio::io::split(TokioIo::new(upgraded));
    Ok(Hijacked { output, input, _connection: connection })
}

/// Passes on what comes, to its end. `framed`: each piece says of which stream it is, as without a terminal.
pub(super) async fn pass(
    from: &mut (impl AsyncRead + Unpin),
    framed: bool,
    output: &Outlet,
) -> std::io::Result<()> {
    let mut buffer = BytesMut::with_capacity(CHUNK);
    let mut frames = Frames::default();
    loop {
        buffer.reserve(CHUNK);
        if from.read_buf(&mut buffer).await? == 0 {
            return Ok(());
        }
        if !framed {
            if output.send(Stream::Stdout, buffer.split().freeze()).await == Err(Gone) {
                return Ok(());
            }
            continue;
        }
        while let Some((stream, data)) = frames.next(&mut buffer) {
            if output.send(stream, data).await == Err(Gone) {
                return Ok(());
            }
        }
    }
}

/// Where in a framed stream one is: `[stream, 0, 0, 0, length as four bytes]`, then so many bytes.
#[derive(Debug, Default)]
struct Frames {
    /// Of the frame that has begun.
    left: usize,
    stream: Option<Stream>,
}

impl Frames {
    /// The next piece of what is there.
    fn next(&mut self, buffer: &mut BytesMut) -> Option<(Stream, Bytes)> {
        loop {
            if self.left > 0 {
                let piece = buffer.split_to(buffer.len().min(self.left));
                self.left -= piece.len();
                match self.stream {
                    _ if piece.is_empty() => return None,
                    Some(stream) => return Some((stream, piece.freeze())),
                    // Nobody asked for what the engine calls another stream.
                    None => continue,
                }
            }
            let header = buffer.get(..8)?;
            self.left = u32::from_be_bytes([header[4], header[5], header[6], header[7]]) as usize;
            self.stream = match header[0] {
                1 => Some(Stream::Stdout),
                2 => Some(Stream::Stderr),
                _ => None,
            };
            buffer.advance(8);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn frames_are_read_however_they_are_cut(
            frames in prop::collection::vec((0_u8..4, prop::collection::vec(any::<u8>(), 0..40)), 0..12),
            cuts in prop::collection::vec(1_usize..30, 1..60),
        ) {
            let mut wire = Vec::new();
            let (mut stdout, mut stderr) = (Vec::new(), Vec::new());
            for (stream, data) in &frames {
                let length = u32::try_from(data.len()).unwrap().to_be_bytes();
                wire.extend([*stream, 0, 0, 0]);
                wire.extend(length);
                wire.extend(data);
                match stream {
                    1 => stdout.extend(data),
                    2 => stderr.extend(data),
                    _ => {}
                }
            }
            let (mut buffer, mut state) = (BytesMut::new(), Frames::default());
            let (mut out, mut err) = (Vec::new(), Vec::new());
            let (mut rest, mut cuts) = (&wire[..], cuts.iter().cycle());
            while !rest.is_empty() {
                let (piece, after) = rest.split_at(rest.len().min(*cuts.next().unwrap()));
                rest = after;
                buffer.extend_from_slice(piece);
                while let Some((stream, data)) = state.next(&mut buffer) {
                    match stream {
                        Stream::Stdout => out.extend(data),
                        Stream::Stderr => err.extend(data),
                    }
                }
            }
            prop_assert_eq!((out, err), (stdout, stderr));
            prop_assert!(buffer.is_empty());
        }
    }
}
