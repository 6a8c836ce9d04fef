//! What waits for one subscriber: bounded, the oldest goes, and something urgent goes before all that is not.
//!
//! A message is taken from here when the kernel takes it, and not before: after [`Outbox::push_urgent`] no byte of what waited is
//! sent any more.

use std::collections::VecDeque;
use std::io;
use std::sync::Mutex;
use std::time::Duration;

use bytes::Bytes;
use tokio::net::TcpStream;
use tokio::sync::Notify;
use tokio::time::Instant;

use super::lock;
use super::unread::is_read;

/// Urgent messages that wait. More are of no use: each says what the one before said.
const MOST_URGENT: usize = 4;

/// A subscriber that takes nothing for so long is given up.
const STALLED: Duration = Duration::from_secs(30);

/// Between two looks whether a subscriber has read what it was sent.
const LOOK: Duration = Duration::from_millis(1);

#[derive(Debug)]
pub(super) struct Outbox {
    stream: TcpStream,
    most: usize,
    /// What is not urgent waits until what was sent before is read.
    paced: bool,
    waiting: Mutex<Waiting>,
    changed: Notify,
}

#[derive(Debug, Default)]
struct Waiting {
    urgent: VecDeque<Bytes>,
    others: VecDeque<Bytes>,
    /// It is given to the kernel, which took a part of it.
    begun: Option<Begun>,
    /// What is urgent would come behind such a part: the subscriber has to connect anew.
    broken: bool,
}

#[derive(Debug)]
struct Begun {
    frame: Bytes,
    taken: usize,
    urgent: bool,
}

/// What came of one turn.
enum Turn {
    /// A message of so many bytes is sent.
    Sent(usize),
    /// None waits.
    Idle,
    /// The kernel takes no more for now.
    Full,
    /// What was sent before is not read.
    Unread,
}

impl Outbox {
    /// At least one message waits in it.
    pub(super) fn new(stream: TcpStream, most: usize, paced: bool) -> Outbox {
        let (waiting, changed) = (Mutex::default(), Notify::new());
        Outbox { stream, most: most.max(1), paced, waiting, changed }
    }

    pub(super) fn push(&self, frame: Bytes) {
        let mut waiting = lock(&self.waiting);
        if waiting.others.len() == self.most {
            waiting.others.pop_front();
        }
        waiting.others.push_back(frame);
        drop(waiting);
        self.changed.notify_one();
    }

    /// In the place of all that waits and is not urgent.
    pub(super) fn push_urgent(&self, frame: Bytes) {
        let mut waiting = lock(&self.waiting);
        waiting.others.clear();
        let begun = waiting.begun.take_if(|begun| !begun.urgent);
        waiting.broken |= begun.is_some_and(|begun| begun.taken > 0);
        if waiting.urgent.len() == MOST_URGENT {
            waiting.urgent.pop_front();
        }
        waiting.urgent.push_back(frame);
        drop(waiting);
        self.changed.notify_one();
    }

    /// Sends what comes, and tells of each message how long it was. Returns when the subscriber is gone, or takes nothing.
    pub(super) async fn send(&self, sent: impl Fn(usize)) {
        let mut stalls_at = Instant::now() + STALLED;
        loop {
            let Ok(turn) = self.turn() else { return };
            if !matches!(turn, Turn::Full) {
                stalls_at = Instant::now() + STALLED;
            }
            // What is waited for is looked at again by the next turn.
            match turn {
                Turn::Sent(length) => sent(length),
                Turn::Idle => self.changed.notified().await,
                Turn::Unread => drop(tokio::time::timeout(LOOK, self.changed.notified()).await),
                Turn::Full => tokio::select! {
                    ready = self.stream.writable() => if ready.is_err() {
                        return;
                    },
                    () = self.changed.notified() => {}
                    () = tokio::time::sleep_until(stalls_at) => return,
                },
            }
        }
    }

    fn turn(&self) -> io::Result<Turn> {
        let mut waiting = lock(&self.waiting);
        if waiting.broken {
            return Err(io::ErrorKind::ConnectionAborted.into());
        }
        if waiting.begun.is_none() {
            let (frame, urgent) = match waiting.urgent.pop_front() {
                Some(frame) => (frame, true),
                None if waiting.others.is_empty() => return Ok(Turn::Idle),
                None if self.paced && !is_read(&self.stream) => return Ok(Turn::Unread),
                None => (waiting.others.pop_front().unwrap_or_default(), false),
            };
            waiting.begun = Some(Begun { frame, taken: 0, urgent });
        }
        let Some(begun) = &mut waiting.begun else { return Ok(Turn::Idle) };
        match self.stream.try_write(&begun.frame[begun.taken..]) {
            Ok(taken) => begun.taken += taken,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(Turn::Full),
            Err(error) => return Err(error),
        }
        let whole = waiting.begun.take_if(|begun| begun.taken == begun.frame.len());
        Ok(whole.map_or(Turn::Full, |whole| Turn::Sent(whole.taken)))
    }

    /// Returns when the subscriber closes its side. It says nothing else.
    pub(super) async fn closed(&self) {
        let mut nothing = [0; 64];
        while self.stream.readable().await.is_ok() {
            match self.stream.try_read(&mut nothing) {
                Ok(1..) => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Ok(0) | Err(_) => return,
            }
        }
    }

    /// Whether the subscriber has read everything, as far as that is known; see [`is_read`].
    pub(super) fn is_delivered(&self) -> bool {
        let waiting = lock(&self.waiting);
        let none = waiting.urgent.is_empty() && waiting.others.is_empty();
        none && waiting.begun.is_none() && is_read(&self.stream)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::AsyncReadExt as _;
    use tokio::net::TcpListener;

    use super::*;

    async fn outbox(most: usize, paced: bool) -> (Outbox, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let to = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (stream, _) = listener.accept().await.unwrap();
        stream.writable().await.unwrap();
        (Outbox::new(stream, most, paced), to)
    }

    async fn read(from: &mut TcpStream, wanted: &str) {
        let mut bytes = vec![0; wanted.len()];
        from.read_exact(&mut bytes).await.unwrap();
        assert_eq!(String::from_utf8(bytes).unwrap(), wanted);
    }

    /// Sends while `then` goes on.
    async fn sending(outbox: &Outbox, then: impl Future<Output = ()>) {
        tokio::select! {
            () = outbox.send(|_| {}) => panic!("it is gone"),
            () = then => {}
        }
    }

    async fn delivered(outbox: &Outbox) {
        while !outbox.is_delivered() {
            tokio::time::sleep(LOOK).await;
        }
    }

    #[tokio::test]
    async fn what_is_urgent_takes_the_place_of_the_rest() {
        let (outbox, mut to) = outbox(2, false).await;
        assert!(outbox.is_delivered());
        for frame in ["a", "b", "c"] {
            outbox.push(Bytes::from(frame));
        }
        assert!(!outbox.is_delivered());
        sending(&outbox, read(&mut to, "bc")).await;
        outbox.push(Bytes::from("d"));
        outbox.push_urgent(Bytes::from("stop"));
        outbox.push(Bytes::from("e"));
        outbox.push_urgent(Bytes::from("cut"));
        outbox.push(Bytes::from("f"));
        sending(&outbox, read(&mut to, "stopcutf")).await;
        delivered(&outbox).await;
    }

    #[tokio::test]
    async fn a_subscriber_that_does_not_read_has_one_message_and_then_the_urgent_one() {
        let (outbox, mut to) = outbox(1, true).await;
        outbox.push(Bytes::from("first"));
        let many = async {
            // The first one has come: what follows takes the place of what waits.
            to.readable().await.unwrap();
            for n in 0..100 {
                outbox.push(Bytes::from(format!("{n}")));
                tokio::time::sleep(LOOK).await;
            }
            assert!(!outbox.is_delivered());
            outbox.push_urgent(Bytes::from("stop"));
        };
        sending(&outbox, many).await;
        outbox.push(Bytes::from("next"));
        sending(&outbox, async {
            read(&mut to, "first").await;
            read(&mut to, "stop").await;
            read(&mut to, "next").await;
        })
        .await;
        delivered(&outbox).await;
    }

    #[tokio::test]
    async fn one_that_is_sent_in_part_is_not_finished_before_something_urgent() {
        let (outbox, mut to) = outbox(1, false).await;
        outbox.push(Bytes::from(vec![b'x'; 64 << 20]));
        let begun = async {
            read(&mut to, "x").await;
        };
        sending(&outbox, begun).await;
        outbox.push_urgent(Bytes::from("stop"));
        outbox.send(|_| {}).await;
        drop(outbox);
        let mut rest = Vec::new();
        let _ = to.read_to_end(&mut rest).await;
        assert!(rest.len() < 64 << 20 && rest.iter().all(|byte| *byte == b'x'));
    }
}
