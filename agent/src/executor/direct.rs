//! Connections of frameworks: where they may come, and what goes over each. `muster_api::direct` says what is spoken.
//!
//! ```text
//!   Door (the link's) ── listener (one task) ── line (one task a connection) ⇄ posts
//! ```
//!
//! Nobody listens before there is an executor. Who connects shows a certificate of the cluster's CA, then a ticket; until then
//! it is a stranger, and there are few of them. Two futures of one task serve a line: one reads whole messages and hands
//! them over, the other writes what the posts have and the answers to what was read.

use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::str::FromStr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::{Buf, BufMut as _, Bytes, BytesMut};
use muster_api::direct::frame::{FrameError, HEADER, Header, Hello, Kind};
use muster_api::direct::{ALPN, Event, Line, MARK_WITHIN, OPEN_WITHIN, Out, STUCK_AFTER};
use muster_api::id::TaskUid;
use muster_api::wire::READ_BUFFER;
use rustix::net::sockopt;
use rustls::ServerConfig;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, BufReader};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::timeout;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

use super::desk::Desks;
use super::post::Reins;

/// Connections that have not yet shown a ticket; for more the oldest have to go.
const MOST_STRANGERS: usize = 8;

/// Connections in all. Each may hold one message that has not come whole; frameworks of more executors go through the
/// controller.
const MOST_LINES: usize = 64;

/// What TLS takes to encrypt before it writes, bytes: fewer and larger writes than with its own 64 KiB.
const WRITE_BUFFER: usize = 256 << 10;

/// Where the agent takes messages of frameworks.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) enum Where {
    /// At a free port of the address by which the controller is reached.
    #[default]
    Own,
    /// Here; port 0: a free one.
    At(SocketAddr),
    /// They go through the controller.
    Nowhere,
}

/// Why a text is no [`Where`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no address; write ADDR, ADDR:PORT or none, as in 192.168.1.7:7450")]
pub(crate) struct WhereError(String);

impl FromStr for Where {
    type Err = WhereError;

    fn from_str(text: &str) -> Result<Where, WhereError> {
        if text == "none" {
            return Ok(Where::Nowhere);
        }
        let address = text.parse::<IpAddr>().map(|ip| SocketAddr::new(ip, 0));
        address.or_else(|_| text.parse()).map(Where::At).map_err(|_| WhereError(text.to_owned()))
    }
}

/// What is shown to frameworks, and whom it believes.
type Tls = watch::Receiver<Arc<ServerConfig>>;

/// Where frameworks may come.
pub(crate) struct Door {
    place: Where,
    /// The newest: a connection has that of its beginning.
    tls: Option<Tls>,
    desks: Arc<Desks>,
    open: Option<Open>,
}

struct Open {
    at: SocketAddr,
    _listener: AbortOnDropHandle<()>,
}

impl fmt::Debug for Door {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let open = self.open.as_ref().map(|open| open.at);
        f.debug_struct("Door").field("place", &self.place).field("open", &open).finish()
    }
}

impl Door {
    pub(crate) fn new(place: Where, tls: Option<Tls>, desks: Arc<Desks>) -> Door {
        Door { place, tls, desks, open: None }
    }

    /// Opens it, and says where frameworks find it; `own` is the address by which the controller is reached. None: they have to
    /// go through the controller.
    pub(crate) async fn address(&mut self, own: Option<IpAddr>) -> Option<String> {
        let tls = self.tls.as_ref()?;
        let wish = match &self.place {
            Where::Nowhere => return None,
            Where::At(address) => *address,
            Where::Own => SocketAddr::new(own?, 0),
        };
        if self.open.as_ref().is_none_or(|open| open.at.ip() != wish.ip()) {
            // The former address is not this machine's any more, most likely.
            self.open = None;
            match listen(wish, tls.clone(), Arc::clone(&self.desks)).await {
                Ok(open) => self.open = Some(open),
                Err(error) => {
                    tracing::warn!(%error, address = %wish, "messages of frameworks pass the controller: nobody can listen");
                }
            }
        }
        let mut told = self.open.as_ref()?.at;
        if told.ip().is_unspecified() {
            told.set_ip(own?);
        }
        Some(told.to_string())
    }
}

async fn listen(at: SocketAddr, tls: Tls, desks: Arc<Desks>) -> io::Result<Open> {
    let listener = TcpListener::bind(at).await?;
    let at = listener.local_addr()?;
    tracing::info!(%at, "takes messages of frameworks");
    let listener = tokio::spawn(serve(listener, tls, desks));
    Ok(Open { at, _listener: AbortOnDropHandle::new(listener) })
}

async fn serve(listener: TcpListener, tls: Tls, desks: Arc<Desks>) {
    let mut strangers: VecDeque<CancellationToken> = VecDeque::new();
    let mut lines = JoinSet::new();
    loop {
        // Cancel-safe: a listener and a set of tasks.
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((_, from)) if lines.len() >= MOST_LINES + MOST_STRANGERS => {
                    tracing::warn!(%from, "too many frameworks come directly");
                }
                Ok((tcp, _)) => {
                    strangers.retain(|stranger| !stranger.is_cancelled());
                    // Who says nothing does not keep others out.
                    if strangers.len() >= MOST_STRANGERS
                        && let Some(oldest) = strangers.pop_front()
                    {
                        oldest.cancel();
                    }
                    let stranger = CancellationToken::new();
                    strangers.push_back(stranger.clone());
                    let tls = TlsAcceptor::from(Arc::clone(&tls.borrow()));
                    lines.spawn(line(tcp, tls, Arc::clone(&desks), stranger));
                }
                Err(error) => {
                    tracing::warn!(%error, "the listener for frameworks");
                    // Out of descriptors, most likely: not in a tight loop.
                    tokio::time::sleep(Duration::from_secs(1)).await;
                }
            },
            Some(_) = lines.join_next() => {}
        }
    }
}

/// Why a line ends.
#[derive(Debug, thiserror::Error)]
enum Ended {
    #[error("the connection")]
    Io(#[from] io::Error),
    #[error("the framework does not speak as it should")]
    Frame(#[from] FrameError),
    #[error("it shows no ticket that holds")]
    NoTicket,
    #[error("it does not say Hello")]
    NoHello,
    #[error("it takes nothing for {} s", STUCK_AFTER.as_secs())]
    Stuck,
    #[error("a frame that a framework does not send, or of another line")]
    Unexpected,
}

type Stream = TlsStream<BufReader<TcpStream>>;

/// A connection from its first byte to its last. `stranger`: it has to make room for others; cancelled when it is none any more.
async fn line(tcp: TcpStream, tls: TlsAcceptor, desks: Arc<Desks>, stranger: CancellationToken) {
    let greeting = stranger.run_until_cancelled(timeout(OPEN_WITHIN, greet(tcp, &tls)));
    let greeted = greeting.await.and_then(Result::ok).unwrap_or(Err(Ended::NoHello));
    let opened = greeted.and_then(|(stream, hello)| {
        let (uid, reins) = desks.posts.open(&hello).ok_or(Ended::NoTicket)?;
        Ok((stream, Guest { desks, uid, line: hello.line, reins }))
    });
    stranger.cancel();
    match opened {
        Ok((stream, guest)) => {
            tracing::info!(uid = %guest.uid, line = %guest.line, "a framework came directly");
            let ended = guest.talk(stream).await;
            let error = ended.err().map(|ended| crate::driver::chain(&ended));
            tracing::info!(uid = %guest.uid, line = %guest.line, error, "a framework's connection ended");
        }
        Err(error) => {
            let error = crate::driver::chain(&error);
            tracing::info!(error, "nobody was let in that came directly");
        }
    }
}

async fn greet(tcp: TcpStream, tls: &TlsAcceptor) -> Result<(Stream, Hello), Ended> {
    watch_over(&tcp)?;
    let mut stream = tls.accept(BufReader::with_capacity(READ_BUFFER, tcp)).await?;
    let session = stream.get_mut().1;
    session.set_buffer_limit(Some(WRITE_BUFFER));
    if session.alpn_protocol() != Some(ALPN) {
        return Err(Ended::NoHello);
    }
    let header = read_header(&mut stream).await?.ok_or(Ended::NoHello)?;
    if header.kind != Kind::Hello {
        return Err(Ended::NoHello);
    }
    let payload = read_payload(&mut stream, header.length).await?;
    Ok((stream, Hello::decode(header, &payload)?))
}

/// A framework that is gone without a word is noticed, and small messages are not kept back.
fn watch_over(tcp: &TcpStream) -> io::Result<()> {
    tcp.set_nodelay(true)?;
    sockopt::set_socket_keepalive(tcp, true)?;
    sockopt::set_tcp_keepidle(tcp, STUCK_AFTER / 2)?;
    sockopt::set_tcp_keepintvl(tcp, STUCK_AFTER / 4)?;
    sockopt::set_tcp_keepcnt(tcp, 2)?;
    let millis = u32::try_from(STUCK_AFTER.as_millis()).unwrap_or(u32::MAX);
    Ok(sockopt::set_tcp_user_timeout(tcp, millis)?)
}

/// A framework that has shown the ticket of an executor. Dropped: its line is no more.
struct Guest {
    desks: Arc<Desks>,
    uid: TaskUid,
    line: Line,
    reins: Reins,
}

impl Drop for Guest {
    fn drop(&mut self) {
        self.desks.posts.happened(&self.uid, Event::Closed(self.line));
    }
}

impl Guest {
    async fn talk(&self, stream: Stream) -> Result<(), Ended> {
        let (mut from, mut to) = tokio::io::split(stream);
        let answers = Answers::default();
        let late = async {
            tokio::time::sleep(MARK_WITHIN).await;
            self.desks.posts.happened(&self.uid, Event::Late(self.line));
            std::future::pending().await
        };
        // None is polled again after another has ended.
        tokio::select! {
            ended = self.read(&mut from, &answers) => ended,
            ended = self.write(&mut to, &answers) => ended,
            () = self.reins.cut.cancelled() => Ok(()),
            ended = late => ended,
        }
    }

    async fn read(
        &self,
        from: &mut (impl AsyncRead + Unpin),
        answers: &Answers,
    ) -> Result<(), Ended> {
        while let Some(header) = read_header(from).await? {
            match header.kind {
                Kind::Message => {
                    let data = read_payload(from, header.length).await?;
                    let Some(taken) = self.desks.arrived(&self.uid, self.line, data) else {
                        return Ok(());
                    };
                    let kind = if taken { Kind::Taken } else { Kind::Refused };
                    answers.push(Header::bare(kind, header.number)).ok_or(Ended::Stuck)?;
                    self.reins.wake.notify_one();
                }
                Kind::Passed if header.number == self.line.number() => {
                    self.desks.posts.happened(&self.uid, Event::Passed(self.line));
                }
                _ => return Err(Ended::Unexpected),
            }
        }
        Ok(())
    }

    async fn write(
        &self,
        to: &mut (impl AsyncWrite + Unpin),
        answers: &Answers,
    ) -> Result<(), Ended> {
        write_frame(to, Header::bare(Kind::Welcome, self.line.number()), Bytes::new()).await?;
        loop {
            if let Some(answer) = answers.pop() {
                write_frame(to, answer, Bytes::new()).await?;
            } else if let Some(out) = self.desks.posts.take(&self.uid, self.line) {
                let (kind, number, data) = match out {
                    Out::Passed => (Kind::Passed, self.line.number(), Bytes::new()),
                    Out::Message(data) => (Kind::Message, 0, data),
                };
                write_frame(to, Header { kind, length: data.len(), number }, data).await?;
            } else {
                self.reins.wake.notified().await;
            }
        }
    }
}

/// Answers that wait. A framework that has sent so many messages and read nothing will not.
const MOST_ANSWERS: usize = 4096;

/// What was done with messages, to be told to the framework.
#[derive(Debug, Default)]
struct Answers(Mutex<VecDeque<Header>>);

impl Answers {
    /// None: there are too many.
    fn push(&self, answer: Header) -> Option<()> {
        let mut answers = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        answers.push_back(answer);
        (answers.len() <= MOST_ANSWERS).then_some(())
    }

    fn pop(&self) -> Option<Header> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }
}

/// None: the other side closed. Not cancel-safe.
async fn read_header(from: &mut (impl AsyncRead + Unpin)) -> Result<Option<Header>, Ended> {
    let mut bytes = [0; HEADER];
    let first = from.read(&mut bytes).await?;
    if first == 0 {
        return Ok(None);
    }
    from.read_exact(&mut bytes[first..]).await?;
    Ok(Some(Header::decode(bytes)?))
}

/// Not cancel-safe.
async fn read_payload(from: &mut (impl AsyncRead + Unpin), length: usize) -> io::Result<Bytes> {
    let mut bytes = BytesMut::with_capacity(length);
    while bytes.len() < length {
        let left = length - bytes.len();
        if from.read_buf(&mut (&mut bytes).limit(left)).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
    }
    Ok(bytes.freeze())
}

/// Not cancel-safe.
async fn write_frame(
    to: &mut (impl AsyncWrite + Unpin),
    header: Header,
    data: Bytes,
) -> Result<(), Ended> {
    let header = header.encode();
    let mut frame = Buf::chain(&header[..], data);
    while frame.has_remaining() {
        let written = timeout(STUCK_AFTER, to.write_buf(&mut frame)).await;
        if written.map_err(|_| Ended::Stuck)?? == 0 {
            return Err(io::Error::from(io::ErrorKind::WriteZero).into());
        }
    }
    timeout(STUCK_AFTER, to.flush()).await.map_err(|_| Ended::Stuck)??;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places() {
        let place = |text: &str| text.parse::<Where>();
        assert_eq!(place("none"), Ok(Where::Nowhere));
        assert_eq!(place("127.0.0.1"), Ok(Where::At("127.0.0.1:0".parse().unwrap())));
        assert_eq!(place("[::1]:7450"), Ok(Where::At("[::1]:7450".parse().unwrap())));
        assert_eq!(place("::1"), Ok(Where::At("[::1]:0".parse().unwrap())));
        for bad in ["", "here", "127.0.0.1:", "host:1", "None"] {
            assert_eq!(place(bad), Err(WhereError(bad.to_owned())));
        }
    }

    #[tokio::test]
    async fn frames_there_and_back_and_cut_off() {
        let mut bytes = Vec::new();
        let data = Bytes::from(vec![7; 100_000]);
        let header = Header { kind: Kind::Message, length: data.len(), number: 5 };
        write_frame(&mut bytes, header, data.clone()).await.unwrap();
        let mut from = bytes.as_slice();
        assert_eq!(read_header(&mut from).await.unwrap(), Some(header));
        assert_eq!(read_payload(&mut from, header.length).await.unwrap(), data);
        assert_eq!(read_header(&mut from).await.unwrap(), None);
        let mut cut = &bytes[..1_000];
        read_header(&mut cut).await.unwrap();
        assert!(read_payload(&mut cut, header.length).await.is_err());
        assert!(read_header(&mut &bytes[..7]).await.is_err());
    }
}
