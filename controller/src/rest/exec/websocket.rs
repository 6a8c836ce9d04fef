//! A program's streams as channels of a WebSocket: each binary message begins with the number of its channel.

use std::time::Duration;

use bytes::{Bytes, BytesMut};
use futures::stream::{SplitSink, SplitStream};
use futures::{Sink, SinkExt as _, StreamExt as _};
use http::{HeaderMap, header};
use hyper::upgrade::{OnUpgrade, Upgraded};
use hyper_util::rt::TokioIo;
use serde_json::Value;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, Role, WebSocketConfig};

use super::{TerminalSize, Visit, failure, host, outcome, switching, tell};
use crate::auth::{self, Asker};
use crate::context::Context;
use crate::rest::failure::Failure;
use crate::rest::path::Verb;
use crate::rest::{Answer, Call};
use crate::session::execs::{Asked, From, Gone, Said, To};

const STDIN: u8 = 0;
const STDOUT: u8 = 1;
const STDERR: u8 = 2;
const ERROR: u8 = 3;
const RESIZE: u8 = 4;
/// Of v5: the channel that is named in the second byte ends.
const CLOSE: u8 = 255;

/// What is spoken, the best first. In v4 only the whole connection has an end, so a program never sees the end of its input.
const PROTOCOLS: [&str; 2] = ["v5.channel.k8s.io", "v4.channel.k8s.io"];

/// The longest message from a client. Some send all of their input as one.
const MOST_BYTES: usize = 4 << 20;

/// How often a client is pinged: one that went away while its program neither reads nor writes shows in no other way.
const PING: Duration = Duration::from_secs(15);

/// A client that has been told the end closes the connection at once; until then what it still sends is read, because its
/// kernel would otherwise throw away what it has not read.
const CLOSES_WITHIN: Duration = Duration::from_secs(5);

/// A client that has taken nothing for so long reads no more, and gives up its place.
const STALL: Duration = Duration::from_secs(30);

type Socket = WebSocketStream<TokioIo<Upgraded>>;

/// Answers that the connection changes, and serves what follows in a task of its own.
pub(super) fn upgrade(call: Call, visit: Visit) -> Answer {
    let Call { context, mut request, .. } = call;
    let (key, protocol) = handshake(request.headers())?;
    let upgrade = request.extensions_mut().remove::<OnUpgrade>();
    let upgrade = upgrade
        .ok_or_else(|| Failure::bad_request("this connection cannot be upgraded; use HTTP/1.1"))?;
    let response = switching([
        (header::CONNECTION, "Upgrade"),
        (header::UPGRADE, "websocket"),
        (header::SEC_WEBSOCKET_ACCEPT, &derive_accept_key(key.as_bytes())),
        (header::SEC_WEBSOCKET_PROTOCOL, protocol),
    ])?;
    let Some(live) = context.live() else {
        return Err(Failure::unavailable("no agent session service is running"));
    };
    let tasks = live.execs.tasks.clone();
    tasks.spawn(async move {
        // An error: the client was gone before it could be answered.
        let Ok(upgraded) = upgrade.await else { return };
        let config = WebSocketConfig::default()
            .max_message_size(Some(MOST_BYTES))
            .max_frame_size(Some(MOST_BYTES));
        let io = TokioIo::new(upgraded);
        let socket = WebSocketStream::from_raw_socket(io, Role::Server, Some(config)).await;
        metrics::gauge!("muster_execs").increment(1);
        serve(&context, socket, visit).await;
        metrics::gauge!("muster_execs").decrement(1);
    });
    Ok(response)
}

/// The client's key, and the best of the protocols that it speaks.
fn handshake(headers: &HeaderMap) -> Result<(String, &'static str), Failure> {
    let words = |name: header::HeaderName| {
        let values = headers.get_all(name).into_iter().filter_map(|value| value.to_str().ok());
        values.flat_map(|value| value.split(',')).map(str::trim)
    };
    let has = |name, word: &str| words(name).any(|w: &str| w.eq_ignore_ascii_case(word));
    if !has(header::CONNECTION, "upgrade") || !has(header::UPGRADE, "websocket") {
        let spdy = words(header::UPGRADE).any(|word| word.starts_with("SPDY/"));
        let why = match spdy {
            true => {
                "SPDY is not spoken here; kubectl speaks WebSocket from 1.31 on (1.30 with KUBECTL_REMOTE_COMMAND_WEBSOCKETS=true)"
            }
            false => "this needs a WebSocket: send `Connection: Upgrade` and `Upgrade: websocket`",
        };
        return Err(Failure::bad_request(why));
    }
    let key = headers.get(header::SEC_WEBSOCKET_KEY).and_then(|key| key.to_str().ok());
    let key = key.filter(|_| has(header::SEC_WEBSOCKET_VERSION, "13"));
    let key = key.ok_or_else(|| {
        Failure::bad_request("the WebSocket handshake lacks a key, or is not of version 13")
    })?;
    let spoken = PROTOCOLS.into_iter().find(|own| has(header::SEC_WEBSOCKET_PROTOCOL, own));
    let spoken = spoken.ok_or_else(|| {
        let why = format!("no subprotocol in common; spoken are {}", PROTOCOLS.join(" and "));
        Failure::bad_request(why)
    })?;
    Ok((key.to_owned(), spoken))
}

async fn serve(context: &Context, socket: Socket, visit: Visit) {
    let (mut sink, mut source) = socket.split();
    let Some(live) = context.live() else { return };
    let status = match live.execs.open(&visit.ready, visit.asked.clone()).await {
        Err(error) => failure(&error).status(),
        Ok(opened) => {
            tell(context, &visit);
            let relay =
                Relay { asked: &visit.asked, node: visit.ready.node.as_str(), to: &opened.to };
            let mut from = opened.from;
            let asked = auth::of_object(Verb::Create, &visit.target);
            let over = async {
                tokio::select! {
                    () = context.stop.cancelled() => Failure::unavailable("the controller ends"),
                    () = auth::until_revoked(context, &visit.who, &asked) => {
                        Failure::denied("the right to enter the task was taken back")
                    }
                    failure = until_closed(context, &visit) => failure,
                }
            };
            match relay.run((&mut sink, &mut source), &mut from, over).await {
                Ok(status) => status,
                // With what is dropped here the program ends.
                Err(Gone) => return,
            }
        }
    };
    let told = async {
        sink.send(framed(ERROR, status.to_string().as_bytes())).await?;
        // With a code: kubectl takes an end without one for a broken connection.
        let close = CloseFrame { code: CloseCode::Normal, reason: "".into() };
        sink.send(Message::Close(Some(close))).await
    };
    if timeout(CLOSES_WITHIN, told).await.is_ok_and(|told| told.is_ok()) {
        let closed = async { while let Some(Ok(_)) = source.next().await {} };
        // A client that is slow to close is left to its kernel.
        drop(timeout(CLOSES_WITHIN, closed).await);
    }
}

/// Returns when access to hosts was taken back from somebody who is in a task that reaches into its node.
async fn until_closed(context: &Context, visit: &Visit) -> Failure {
    if visit.asked.command.is_empty() {
        return std::future::pending().await;
    }
    loop {
        tokio::time::sleep(auth::LOOK_AGAIN).await;
        let asker = Asker::with(context, visit.who.clone());
        if let Err(failure) = host::check_entry(&asker, &visit.task) {
            return failure;
        }
    }
}

/// A client and its program.
struct Relay<'a> {
    asked: &'a Asked,
    node: &'a str,
    to: &'a To,
}

impl Relay<'_> {
    /// Until the program has ended, which is told as a Status, or the client is gone. Two directions of which neither waits
    /// for the other: a program may say nothing before it has read all, and the other way round.
    async fn run(
        &self,
        (sink, source): (&mut SplitSink<Socket, Message>, &mut SplitStream<Socket>),
        from: &mut From,
        over: impl Future<Output = Failure>,
    ) -> Result<Value, Gone> {
        tokio::select! {
            status = self.outward(sink, from) => status,
            () = self.inward(source) => Err(Gone),
            why = over => Ok(why.status()),
        }
    }

    async fn outward(
        &self,
        sink: &mut SplitSink<Socket, Message>,
        from: &mut From,
    ) -> Result<Value, Gone> {
        // As Kubernetes does: an empty message says that the channels are open.
        let first = match self.asked {
            Asked { stdout: true, .. } => STDOUT,
            Asked { stderr: true, .. } => STDERR,
            _ => ERROR,
        };
        send(sink, framed(first, &[])).await?;
        let mut pings = interval(PING);
        pings.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let (channel, data) = tokio::select! {
                said = from.next() => match said {
                    Some(Said::Stdout(data)) => (STDOUT, data),
                    Some(Said::Stderr(data)) => (STDERR, data),
                    Some(Said::End(end)) => return Ok(outcome(Some(end), self.node)),
                    None => return Ok(outcome(None, self.node)),
                },
                _ = pings.tick() => {
                    send(sink, Message::Ping(Bytes::new())).await?;
                    continue;
                }
            };
            send(sink, framed(channel, &data)).await?;
            // Gone: its end is the next thing that it says.
            let _ = self.to.taken(data.len()).await;
        }
    }

    /// Ends when the client is gone. What a program that has ended does not read any more is dropped.
    async fn inward(&self, source: &mut SplitStream<Socket>) {
        while let Some(Ok(message)) = source.next().await {
            let mut data = match message {
                Message::Binary(data) => data,
                // Python's client sends what is text as text.
                Message::Text(text) => Bytes::from(text),
                Message::Close(_) => return,
                _ => continue,
            };
            if data.is_empty() {
                continue;
            }
            let channel = data.split_to(1)[0];
            let _ = match (channel, &data[..]) {
                (STDIN, [_, ..]) if self.asked.stdin => self.to.stdin(data).await,
                (CLOSE, [STDIN]) if self.asked.stdin => self.to.end().await,
                (RESIZE, size) => match serde_json::from_slice::<TerminalSize>(size) {
                    Ok(TerminalSize { width, height }) => self.to.size(width, height).await,
                    Err(_) => continue,
                },
                _ => continue,
            };
        }
    }
}

/// Sends a message to a client that reads.
async fn send<S: Sink<Message> + Unpin>(sink: &mut S, message: Message) -> Result<(), Gone> {
    match timeout(STALL, sink.send(message)).await {
        Ok(Ok(())) => Ok(()),
        Ok(Err(_)) | Err(_) => Err(Gone),
    }
}

fn framed(channel: u8, data: &[u8]) -> Message {
    let mut message = BytesMut::with_capacity(data.len() + 1);
    message.extend_from_slice(&[channel]);
    message.extend_from_slice(data);
    Message::Binary(message.freeze())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_client_that_does_not_read_is_gone() {
        let (mut sink, _unread) = futures::channel::mpsc::channel(1);
        assert!(send(&mut sink, framed(STDOUT, b"a")).await.is_ok(), "there is room for one");
        assert!(send(&mut sink, framed(STDOUT, b"b")).await.is_err());
    }

    fn headers(pairs: &[(&str, &str)]) -> HeaderMap {
        let pair = |(name, value): &(&str, &str)| {
            let name: header::HeaderName = name.parse().unwrap();
            (name, value.parse().unwrap())
        };
        pairs.iter().map(pair).collect()
    }

    #[test]
    fn handshakes() {
        let websocket = [
            ("connection", "keep-alive, Upgrade"),
            ("upgrade", "WebSocket"),
            ("sec-websocket-key", "dGhlIHNhbXBsZSBub25jZQ=="),
            ("sec-websocket-version", "13"),
        ];
        let with = |protocols: &str| {
            let mut pairs = websocket.to_vec();
            pairs.push(("sec-websocket-protocol", protocols));
            handshake(&headers(&pairs)).map(|(_, protocol)| protocol)
        };
        assert_eq!(with("v4.channel.k8s.io,v5.channel.k8s.io").unwrap(), "v5.channel.k8s.io");
        assert_eq!(with("v4.channel.k8s.io, other").unwrap(), "v4.channel.k8s.io");
        assert!(with("other").unwrap_err().message().contains("v5.channel.k8s.io and"));
        let refused = |pairs: &[(&str, &str)]| handshake(&headers(pairs)).unwrap_err();
        assert!(refused(&[]).message().contains("needs a WebSocket"));
        let spdy = [("connection", "Upgrade"), ("upgrade", "SPDY/3.1")];
        assert!(refused(&spdy).message().contains("from 1.31 on"));
        assert!(refused(&websocket[..3]).message().contains("version 13"));
    }
}
