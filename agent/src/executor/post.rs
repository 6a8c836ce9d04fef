//! Messages between executors and their frameworks: which way each goes, and who may come directly.
//!
//! ```text
//!   seat ──say──▶ posts ──▶ relayed (queue) ──▶ link ──▶ controller
//!                   │ ▲──── hear ◀───────────── link
//!                   ▼ │
//!               direct (one task a connection)
//! ```
//!
//! One lock: a decision and what follows from it are one step, so messages leave in the order in which they came. It is
//! taken before the desks' lock, never inside it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use muster_api::direct::frame::Hello;
use muster_api::direct::{Effect, End, Event, Line, Out, Secret};
use muster_api::id::TaskUid;
use muster_api::wire::agent::v1::{Message, Tickets};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::desk::Desks;
use super::frame::MESSAGE_MAX;
use super::queue::{MOST_BYTES, Queue, Refused, cost};

/// One executor's.
#[derive(Debug, Default)]
struct Post {
    end: End<Bytes>,
    /// With it its framework may come.
    ticket: Option<Secret>,
    /// The task of the present line.
    reins: Option<Reins>,
}

/// How the task of a line is told.
#[derive(Debug, Clone, Default)]
pub(super) struct Reins {
    /// There is something to take.
    pub(super) wake: Arc<Notify>,
    /// It has to end.
    pub(super) cut: CancellationToken,
}

#[derive(Debug, Default)]
pub(super) struct Table {
    posts: BTreeMap<TaskUid, Post>,
    /// What waits for lines, of all executors, as [`cost`]: bounded as what waits for the controller is.
    waiting: usize,
}

/// All of them.
#[derive(Debug, Default)]
pub(crate) struct Posts {
    table: Mutex<Table>,
    /// Messages and marks for frameworks, through the controller.
    relayed: Queue<Message>,
}

impl Posts {
    pub(super) fn table(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The executors that may be there; the others' frameworks have to go.
    pub(super) fn keep_only(&self, table: &mut Table, there: &BTreeSet<TaskUid>) {
        let gone: Vec<TaskUid> =
            table.posts.keys().filter(|uid| !there.contains(*uid)).cloned().collect();
        for uid in gone {
            self.leave(table, &uid);
            table.posts.remove(&uid);
        }
    }

    /// Carries out what the executor's end decides. True: the message that came is for the executor.
    fn handle(&self, table: &mut Table, uid: &TaskUid, event: Event<Bytes>) -> bool {
        let Some(post) = table.posts.get_mut(uid) else { return false };
        let mut deliver = false;
        for effect in post.end.handle(event) {
            match effect {
                Effect::Deliver => deliver = true,
                Effect::Relay(data) => {
                    table.waiting -= cost(data.len());
                    self.relay(uid, data);
                }
                Effect::Mark(line) => {
                    let mark = line.number();
                    let executor = uid.to_string();
                    let mark = Message { executor, mark, ..Message::default() };
                    // One that is lost ends its line: what waits for that goes the other way.
                    if let Err(why) = self.relayed.push(mark, 0) {
                        tracing::debug!(%uid, ?why, "a mark is lost");
                    }
                }
                Effect::Wake(_) => {
                    if let Some(reins) = &post.reins {
                        reins.wake.notify_one();
                    }
                }
                Effect::Close(_) => {
                    if let Some(reins) = post.reins.take() {
                        reins.cut.cancel();
                    }
                }
            }
        }
        deliver
    }

    fn relay(&self, uid: &TaskUid, data: Bytes) {
        let size = data.len();
        let message = Message { executor: uid.to_string(), data, mark: 0 };
        match self.relayed.push(message, size) {
            Ok(()) => {}
            Err(Refused::Shut) => {
                tracing::debug!(%uid, size, "an executor's message is lost: no controller");
            }
            Err(Refused::Full) => {
                tracing::warn!(%uid, size, "an executor's message is lost: the controller does not keep up");
            }
        }
    }

    fn leave(&self, table: &mut Table, uid: &TaskUid) {
        if let Some(line) = table.posts.get(uid).and_then(|post| post.end.line()) {
            self.handle(table, uid, Event::Closed(line));
        }
    }

    /// The next thing to write to a line.
    pub(super) fn take(&self, uid: &TaskUid, line: Line) -> Option<Out<Bytes>> {
        let mut table = self.table();
        let out = table.posts.get_mut(uid)?.end.take(line)?;
        if let Out::Message(data) = &out {
            table.waiting -= cost(data.len());
        }
        Some(out)
    }

    /// Something happened to a line.
    pub(super) fn happened(&self, uid: &TaskUid, event: Event<Bytes>) {
        self.handle(&mut self.table(), uid, event);
    }

    /// Lets a framework in that shows the executor's ticket; none: it has to go. An earlier one of the executor goes.
    pub(super) fn open(&self, hello: &Hello) -> Option<(TaskUid, Reins)> {
        let mut table = self.table();
        let uid = TaskUid::new(hello.executor.as_str());
        let ticket = table.posts.get(&uid).and_then(|post| post.ticket.as_ref());
        if ticket.is_none_or(|ticket| *ticket != hello.secret) {
            return None;
        }
        self.leave(&mut table, &uid);
        let reins = Reins::default();
        table.posts.get_mut(&uid)?.reins = Some(reins.clone());
        self.handle(&mut table, &uid, Event::Opened(hello.line));
        Some((uid, reins))
    }
}

/// A time in which the controller can be reached.
#[derive(Debug)]
pub(crate) struct InReach<'a>(&'a Queue<Message>);

impl InReach<'_> {
    /// What was under way is lost.
    pub(crate) fn broke(&self) {
        self.0.clear();
    }
}

impl Drop for InReach<'_> {
    fn drop(&mut self) {
        self.0.shut();
    }
}

impl Desks {
    /// A message of an executor for its framework.
    pub(super) fn say(&self, uid: &TaskUid, data: Bytes) {
        let (posts, size) = (&self.posts, data.len());
        let mut table = posts.table();
        if size > MESSAGE_MAX || table.waiting + cost(size) > MOST_BYTES {
            tracing::warn!(%uid, size, "an executor's message is dropped");
        } else if table.posts.contains_key(uid) {
            table.waiting += cost(size);
            posts.handle(&mut table, uid, Event::Send(data));
        } else {
            posts.relay(uid, data);
        }
    }

    /// The next message or mark for a framework. Cancel-safe.
    pub(crate) async fn said(&self) -> Message {
        self.posts.relayed.pop().await
    }

    /// The controller is there, until what this gives is dropped: what is said meanwhile waits for it, and is lost at other
    /// times.
    pub(crate) fn in_reach(&self) -> InReach<'_> {
        self.posts.relayed.open();
        InReach(&self.posts.relayed)
    }

    /// A message or a mark of a framework, through the controller.
    pub(crate) fn hear(&self, message: Message) {
        let Message { executor, data, mark } = message;
        let uid = TaskUid::new(executor);
        let mut table = self.posts.table();
        if let Some(line) = Line::new(mark) {
            self.posts.handle(&mut table, &uid, Event::Marked(line));
            return;
        }
        if !table.posts.contains_key(&uid) || self.posts.handle(&mut table, &uid, Event::Relayed) {
            // Under the lock: what comes directly after it stays after it.
            self.hand_over(&uid, data);
        }
    }

    /// A message of a framework over a line. None: the line is no more.
    pub(super) fn arrived(&self, uid: &TaskUid, line: Line, data: Bytes) -> Option<bool> {
        let mut table = self.posts.table();
        let deliver = self.posts.handle(&mut table, uid, Event::Arrived(line));
        deliver.then(|| self.hand_over(uid, data))
    }

    /// Who may come. Whoever came with another ticket has to go.
    pub(crate) fn admit(&self, tickets: Tickets) {
        let mut table = self.posts.table();
        let there = self.executors.borrow().clone();
        for ticket in tickets.tickets {
            let (uid, secret) = (TaskUid::new(ticket.executor), Secret::read(&ticket.secret));
            if !there.contains(&uid) {
                continue;
            }
            let post = table.posts.entry(uid.clone()).or_default();
            if post.ticket != secret {
                post.ticket = secret;
                self.posts.leave(&mut table, &uid);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use muster_api::wire::agent::v1::Ticket;

    use super::*;

    fn secret(byte: u8) -> Secret {
        Secret::new([byte; 32])
    }

    fn hello(line: u64, byte: u8) -> Hello {
        let line = Line::new(line).unwrap();
        Hello { line, executor: "e".to_owned(), secret: secret(byte) }
    }

    fn desks(dir: &std::path::Path) -> Desks {
        let checkpoint = crate::checkpoint::Checkpoint::open(dir).unwrap();
        let desks = Desks::new(checkpoint, "n".to_owned());
        desks.executors.send_replace(BTreeSet::from([TaskUid::new("e")]));
        desks
    }

    fn admit(desks: &Desks, secret: &[u8]) {
        let ticket = Ticket { executor: "e".to_owned(), secret: secret.to_vec() };
        desks.admit(Tickets { tickets: vec![ticket] });
    }

    #[test]
    fn a_ticket_lets_in_until_there_is_another_one() {
        let dir = tempfile::tempdir().unwrap();
        let desks = desks(dir.path());
        let posts = &desks.posts;
        assert!(posts.open(&hello(1, 7)).is_none(), "nobody may come yet");
        admit(&desks, &[7; 32]);
        assert!(posts.open(&hello(1, 8)).is_none(), "another's");
        let stranger = Hello { executor: "x".to_owned(), ..hello(1, 7) };
        assert!(posts.open(&stranger).is_none(), "another executor's");
        let (_, first) = posts.open(&hello(1, 7)).unwrap();
        admit(&desks, &[7; 32]);
        assert!(!first.cut.is_cancelled(), "the same word again");
        let (_, second) = posts.open(&hello(2, 7)).unwrap();
        assert!(first.cut.is_cancelled() && !second.cut.is_cancelled());
        admit(&desks, &[8; 32]);
        assert!(second.cut.is_cancelled() && posts.open(&hello(3, 7)).is_none());
        let (_, third) = posts.open(&hello(3, 8)).unwrap();
        admit(&desks, &[]);
        assert!(third.cut.is_cancelled() && posts.open(&hello(4, 8)).is_none());

        admit(&desks, &[9; 32]);
        let (_, last) = posts.open(&hello(5, 9)).unwrap();
        posts.keep_only(&mut posts.table(), &BTreeSet::new());
        assert!(last.cut.is_cancelled() && posts.open(&hello(6, 9)).is_none(), "it has ended");
        assert!(posts.table().posts.is_empty());
    }

    #[tokio::test]
    async fn what_waits_for_a_line_is_bounded_and_goes_the_other_way_when_it_breaks() {
        let dir = tempfile::tempdir().unwrap();
        let desks = desks(dir.path());
        admit(&desks, &[7; 32]);
        let line = Line::new(1).unwrap();
        let (uid, _reins) = desks.posts.open(&hello(1, 7)).unwrap();
        assert_eq!(desks.said().await.mark, 1);
        let _in_reach = desks.in_reach();
        let large = Bytes::from(vec![1; MESSAGE_MAX]);
        for _ in 0..5 {
            desks.say(&uid, large.clone());
        }
        assert_eq!(desks.posts.table().waiting, MOST_BYTES, "the fifth is dropped");
        desks.posts.happened(&uid, Event::Passed(line));
        assert_eq!(desks.posts.take(&uid, line), Some(Out::Message(large.clone())));
        assert_eq!(desks.posts.table().waiting, 3 * cost(MESSAGE_MAX));
        desks.say(&uid, "last".into());
        desks.posts.happened(&uid, Event::Closed(line));
        assert_eq!(desks.posts.table().waiting, 0);
        for expected in [&large, &large, &large, &Bytes::from("last")] {
            let message = desks.said().await;
            assert!(message.mark == 0 && message.data == *expected);
        }
        desks.say(&uid, "through the controller".into());
        assert_eq!(desks.said().await.data, "through the controller");
    }
}
