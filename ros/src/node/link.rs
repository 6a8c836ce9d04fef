//! One publisher of a topic, as its subscriber keeps it connected.

use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncWriteExt as _, BufReader};
use tokio::net::TcpStream;
use tokio::time::Instant;

use super::Shared;
use super::bus::{Connection, Direction};
use super::registrar::chain;
use super::subscription::{From, Incoming, Subscription};
use crate::master::{MasterError, unpack};
use crate::tcpros::{Header, HeaderError, LARGEST_HEADER, ReadError, read_frame, skip_frame};
use crate::xmlrpc::Value;
use crate::xmlrpc::http::{CallError, Uri, invoke};

/// First and longest pause before a publisher is tried again. One that was killed stays in the master's list for ever.
const PAUSE: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(5));
/// For connecting, and for each header.
const PATIENCE: Duration = Duration::from_secs(5);

/// Why a publisher is not connected.
#[derive(Debug, thiserror::Error)]
enum LinkError {
    #[error("failed to ask {uri} for the topic")]
    Ask { uri: Uri, source: Box<CallError> },
    #[error(transparent)]
    Answer(#[from] MasterError),
    #[error("failed to connect to {host}:{port}")]
    Connect { host: String, port: u16, source: std::io::Error },
    #[error("it did not answer in time")]
    Timeout,
    #[error("its connection header is none")]
    Header(#[from] HeaderError),
    #[error("it refuses: {0}")]
    Refused(String),
    #[error("it publishes {kind} with checksum {md5}, not {wanted}")]
    OtherType { kind: String, md5: String, wanted: &'static str },
    #[error(transparent)]
    Read(#[from] ReadError),
}

/// Keeps one publisher connected.
pub(super) async fn attend(uri: Uri, subscription: Arc<Subscription>, shared: Arc<Shared>) {
    let mut pause = PAUSE.0;
    let connection = shared.bus.add(Direction::In, subscription.topic(), &uri.to_string());
    loop {
        let begun = Instant::now();
        let ended = link(&uri, &subscription, &shared, &connection).await;
        connection.set_connected(false);
        let Err(error) = ended;
        let why = chain(&error);
        tracing::debug!(topic = subscription.topic(), publisher = %uri, why, "not connected to a publisher");
        subscription.say(&uri, Err(why));
        subscription.let_go(&uri);
        if begun.elapsed() > PAUSE.1 {
            pause = PAUSE.0;
        }
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(PAUSE.1);
    }
}

async fn link(
    uri: &Uri,
    subscription: &Subscription,
    shared: &Shared,
    connection: &Connection,
) -> Result<std::convert::Infallible, LinkError> {
    let opened = tokio::time::timeout(PATIENCE * 2, open(uri, subscription, shared));
    let (mut stream, from) = opened.await.map_err(|_| LinkError::Timeout)??;
    connection.set_connected(true);
    subscription.say(uri, Ok(()));
    loop {
        let size = if subscription.only_counts() {
            skip_frame(&mut stream, subscription.largest()).await?
        } else {
            let body = read_frame(&mut stream, subscription.largest()).await?;
            let (size, received) = (body.len(), Instant::now());
            subscription.push(Incoming { body, received, from: Arc::clone(&from) });
            size
        };
        subscription.arrived();
        connection.passed(size);
    }
}

/// A connection on which messages follow.
async fn open(
    uri: &Uri,
    subscription: &Subscription,
    shared: &Shared,
) -> Result<(BufReader<TcpStream>, Arc<From>), LinkError> {
    let (host, port) = ask(uri, subscription, shared).await?;
    let connected = TcpStream::connect((&*host, port)).await;
    let stream = connected.map_err(|source| LinkError::Connect { host, port, source })?;
    keep_alive(&stream);
    let header = Header::new([
        ("callerid", &*shared.name),
        ("topic", subscription.topic()),
        ("type", subscription.kind()),
        ("md5sum", subscription.md5()),
        ("tcp_nodelay", "1"),
    ]);
    let mut stream = BufReader::new(stream);
    stream.write_all(&header.encode()).await.map_err(ReadError::from)?;
    let answer = Header::decode(&read_frame(&mut stream, LARGEST_HEADER).await?)?;
    if let Some(error) = answer.get("error") {
        return Err(LinkError::Refused(error.to_owned()));
    }
    let field = |key| answer.get(key).unwrap_or_default().to_owned();
    let from = From {
        caller: field("callerid"),
        kind: field("type"),
        md5: field("md5sum"),
        definition: field("message_definition"),
    };
    let fits = |wanted: &str, found: &str| wanted == "*" || found == "*" || wanted == found;
    if !fits(subscription.md5(), &from.md5) {
        return Err(LinkError::OtherType {
            kind: from.kind,
            md5: from.md5,
            wanted: subscription.kind(),
        });
    }
    Ok((stream, Arc::new(from)))
}

/// Where the publisher gives the topic.
async fn ask(
    uri: &Uri,
    subscription: &Subscription,
    shared: &Shared,
) -> Result<(String, u16), LinkError> {
    let protocols = Value::Array(vec![Value::Array(vec!["TCPROS".into()])]);
    let params = [(&*shared.name).into(), subscription.topic().into(), protocols];
    let answer = invoke(uri, "requestTopic", &params).await;
    let answer =
        answer.map_err(|source| LinkError::Ask { uri: uri.clone(), source: Box::new(source) })?;
    Ok(unpack("requestTopic", &answer, |value| match value.as_array()? {
        [protocol, host, port, ..] if protocol.as_str() == Some("TCPROS") => {
            Some((host.as_str()?.to_owned(), u16::try_from(port.as_int()?).ok()?))
        }
        _ => None,
    })?)
}

/// A publisher whose machine lost power says nothing, and a topic may be silent for hours: the kernels ask each other.
fn keep_alive(stream: &TcpStream) {
    use rustix::net::sockopt;
    let idle = sockopt::set_socket_keepalive(stream, true)
        .and_then(|()| sockopt::set_tcp_keepidle(stream, Duration::from_secs(10)))
        .and_then(|()| sockopt::set_tcp_keepintvl(stream, Duration::from_secs(5)))
        .and_then(|()| sockopt::set_tcp_keepcnt(stream, 3));
    if let Err(error) = idle.and_then(|()| sockopt::set_tcp_nodelay(stream, true)) {
        tracing::debug!(%error, "options of a connection were not set");
    }
}
