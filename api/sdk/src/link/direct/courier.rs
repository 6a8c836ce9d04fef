//! One executor's connection to its agent: made when it is wanted, made again when it is wanted again.

use std::collections::VecDeque;
use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::{Buf, BufMut as _, Bytes, BytesMut};
use muster_api::direct::frame::{FrameError, HEADER, Header, Hello, Kind};
use muster_api::direct::{Event, Line, MARK_WITHIN, OPEN_WITHIN, Out, STUCK_AFTER};
use muster_api::wire::READ_BUFFER;
use rustix::net::sockopt;
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, BufReader};
use tokio::net::TcpStream;
use tokio::sync::{Notify, watch};
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use super::{Door, Lanes, Reins};
use crate::CallRefused;
use crate::backoff::Backoff;
use crate::link::pending::Answered;
use crate::link::session::chain;

/// What TLS takes to encrypt before it writes, bytes: fewer and larger writes than with its own 64 KiB.
const WRITE_BUFFER: usize = 256 << 10;

/// Why a line ended.
#[derive(Debug, thiserror::Error)]
enum Ended {
    #[error("the connection")]
    Io(#[from] io::Error),
    #[error("the agent does not speak as it should")]
    Frame(#[from] FrameError),
    #[error("the agent closed it")]
    Closed,
    #[error("the agent does not welcome this framework")]
    NotWelcome,
    #[error("the agent has done nothing for {} s", STUCK_AFTER.as_secs())]
    Stuck,
    #[error("a frame that an agent does not send, or of another line")]
    Unexpected,
    #[error("it holds no more")]
    Cut,
}

/// Keeps a connection for as long as one is wanted.
pub(super) async fn run(
    lanes: Lanes,
    executor: String,
    mut doors: watch::Receiver<Option<Door>>,
    wanted: Arc<Notify>,
) {
    let mut backoff = Backoff::new();
    loop {
        wanted.notified().await;
        let Some(door) = doors.borrow_and_update().clone() else {
            // Closed: the lane is gone, and this task with it.
            drop(doors.changed().await);
            continue;
        };
        let begun = Instant::now();
        let line = new_line();
        let Some(reins) = lanes.dialled(&executor, line) else { return };
        let trip = Trip { lanes: &lanes, executor: &executor, line, reins };
        let ended = trip.travel(&door).await;
        tracing::debug!(executor, %line, address = door.address, why = ended.map_or_else(|e| chain(&e), |never| match never {}), "messages pass the controller");
        drop(trip);
        if begun.elapsed() > STUCK_AFTER {
            backoff.reset();
        }
        // Cancel-safe: a sleep, and a change that is seen at the next look.
        tokio::select! {
            () = sleep(backoff.pause()) => {}
            changed = doors.changed() => drop(changed),
        }
    }
}

fn new_line() -> Line {
    loop {
        // The keys of a hasher are the one source of randomness in std; it must be another number, not a secret one.
        if let Some(line) = Line::new(RandomState::new().build_hasher().finish()) {
            return line;
        }
    }
}

/// One connection. Dropped: its line is no more.
struct Trip<'a> {
    lanes: &'a Lanes,
    executor: &'a str,
    line: Line,
    reins: Reins,
}

impl Drop for Trip<'_> {
    fn drop(&mut self) {
        self.lanes.happened(self.executor, Event::Closed(self.line));
    }
}

impl Trip<'_> {
    async fn travel(&self, door: &Door) -> Result<std::convert::Infallible, Ended> {
        let dial = timeout(OPEN_WITHIN, self.dial(door));
        let stream = tokio::select! {
            dialled = dial => dialled.unwrap_or(Err(Ended::Stuck))?,
            () = self.reins.cut.cancelled() => return Err(Ended::Cut),
        };
        self.lanes.happened(self.executor, Event::Opened(self.line));
        tracing::debug!(executor = self.executor, line = %self.line, address = door.address, "connected to the agent");
        let (mut from, mut to) = tokio::io::split(stream);
        let under_way = UnderWay::default();
        let late = async {
            sleep(MARK_WITHIN).await;
            self.lanes.happened(self.executor, Event::Late(self.line));
            std::future::pending().await
        };
        // None is polled again after another has ended.
        tokio::select! {
            ended = self.read(&mut from, &under_way) => ended,
            ended = self.write(&mut to, &under_way) => ended,
            ended = under_way.overdue() => ended,
            () = self.reins.cut.cancelled() => Err(Ended::Cut),
            ended = late => ended,
        }
    }

    async fn dial(&self, door: &Door) -> Result<TlsStream<BufReader<TcpStream>>, Ended> {
        let name = ServerName::try_from(door.server_name.clone()).map_err(io::Error::other)?;
        let tcp = TcpStream::connect(&door.address).await?;
        watch_over(&tcp)?;
        let tcp = BufReader::with_capacity(READ_BUFFER, tcp);
        let connector = TlsConnector::from(Arc::clone(&self.lanes.0.tls));
        let mut stream = connector.connect(name, tcp).await?;
        stream.get_mut().1.set_buffer_limit(Some(WRITE_BUFFER));
        let (line, executor) = (self.line, self.executor.to_owned());
        let hello = Hello { line, executor, secret: door.secret.clone() };
        stream.write_all(&hello.encode()).await?;
        stream.flush().await?;
        match read_header(&mut stream).await {
            Ok(header) if header == Header::bare(Kind::Welcome, line.number()) => Ok(stream),
            Ok(_) | Err(Ended::Closed) => Err(Ended::NotWelcome),
            Err(error) => Err(error),
        }
    }

    async fn read(
        &self,
        from: &mut (impl AsyncRead + Unpin),
        under_way: &UnderWay,
    ) -> Result<std::convert::Infallible, Ended> {
        let mut buffer = BytesMut::new();
        loop {
            let header = read_header(from).await?;
            match header.kind {
                Kind::Message => {
                    let data = read_payload(from, &mut buffer, header.length).await?;
                    if !self.lanes.arrived(self.executor, self.line, data) {
                        return Err(Ended::Cut);
                    }
                }
                Kind::Taken => under_way.answer(header.number, Ok(Vec::new()))?,
                Kind::Refused => under_way.answer(header.number, Err(CallRefused::not_taken()))?,
                Kind::Passed if header.number == self.line.number() => {
                    self.lanes.happened(self.executor, Event::Passed(self.line));
                }
                _ => return Err(Ended::Unexpected),
            }
        }
    }

    async fn write(
        &self,
        to: &mut (impl AsyncWrite + Unpin),
        under_way: &UnderWay,
    ) -> Result<std::convert::Infallible, Ended> {
        let mut last = 0;
        loop {
            match self.lanes.take(self.executor, self.line) {
                Some(Out::Message(outgoing)) => {
                    last += 1;
                    under_way.add(last, outgoing.answered);
                    let header =
                        Header { kind: Kind::Message, length: outgoing.data.len(), number: last };
                    write_frame(to, header, outgoing.data).await?;
                    drop(outgoing.room);
                }
                Some(Out::Passed) => {
                    let passed = Header::bare(Kind::Passed, self.line.number());
                    write_frame(to, passed, Bytes::new()).await?;
                }
                None => self.reins.wake.notified().await,
            }
        }
    }
}

/// Messages that were begun to be written and have no answer. Dropped: nobody knows what became of them.
#[derive(Debug, Default)]
struct UnderWay {
    /// By their numbers, which grow, and when each began.
    messages: Mutex<VecDeque<(u64, Answered, Instant)>>,
    more: Notify,
}

impl UnderWay {
    fn messages(&self) -> MutexGuard<'_, VecDeque<(u64, Answered, Instant)>> {
        self.messages.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn add(&self, number: u64, answered: Answered) {
        self.messages().push_back((number, answered, Instant::now()));
        self.more.notify_one();
    }

    /// Agents answer in the order of the messages.
    fn answer(
        &self,
        number: u64,
        answer: Result<Vec<muster_api::wire::framework::v1::Launched>, CallRefused>,
    ) -> Result<(), Ended> {
        let first = self.messages().pop_front();
        let (_, answered, _) = first.filter(|(n, ..)| *n == number).ok_or(Ended::Unexpected)?;
        // Who no longer waits does not need it.
        drop(answered.send(answer));
        Ok(())
    }

    /// Ends when an answer does not come. A message of the longest takes so long on a link of a megabyte a second.
    async fn overdue(&self) -> Result<std::convert::Infallible, Ended> {
        loop {
            let oldest = self.messages().front().map(|(.., begun)| *begun);
            match oldest {
                Some(begun) if begun.elapsed() >= STUCK_AFTER => return Err(Ended::Stuck),
                Some(begun) => sleep_until(begun + STUCK_AFTER).await,
                None => self.more.notified().await,
            }
        }
    }
}

impl Drop for UnderWay {
    fn drop(&mut self) {
        for (_, answered, _) in self.messages().drain(..) {
            drop(answered.send(Err(CallRefused::disconnected())));
        }
    }
}

/// An agent that is gone without a word is noticed, and small messages are not kept back.
fn watch_over(tcp: &TcpStream) -> io::Result<()> {
    tcp.set_nodelay(true)?;
    sockopt::set_socket_keepalive(tcp, true)?;
    sockopt::set_tcp_keepidle(tcp, STUCK_AFTER / 2)?;
    sockopt::set_tcp_keepintvl(tcp, STUCK_AFTER / 4)?;
    sockopt::set_tcp_keepcnt(tcp, 2)?;
    let millis = u32::try_from(STUCK_AFTER.as_millis()).unwrap_or(u32::MAX);
    Ok(sockopt::set_tcp_user_timeout(tcp, millis)?)
}

/// Not cancel-safe.
async fn read_header(from: &mut (impl AsyncRead + Unpin)) -> Result<Header, Ended> {
    let mut bytes = [0; HEADER];
    match from.read_exact(&mut bytes).await {
        Ok(_) => Ok(Header::decode(bytes)?),
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Err(Ended::Closed),
        Err(error) => Err(error.into()),
    }
}

/// Into `buffer`, whose memory is used again once nobody holds the message before. Not cancel-safe.
async fn read_payload(
    from: &mut (impl AsyncRead + Unpin),
    buffer: &mut BytesMut,
    length: usize,
) -> io::Result<Bytes> {
    buffer.reserve(length);
    while buffer.len() < length {
        let left = length - buffer.len();
        if from.read_buf(&mut (&mut *buffer).limit(left)).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
    }
    Ok(buffer.split().freeze())
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
