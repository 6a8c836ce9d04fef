//! Messages of executors: over a connection to each one's agent where there is one, through the controller otherwise.
//!
//! ```text
//!   handle ──send──▶ lanes ── Relayed ──▶ session ──▶ controller
//!   stream ◀─────────  │ ▲ ◀─────────────  session ◀──
//!                      ▼ │
//!                   courier (one task an executor) ◀═══▶ agent
//! ```
//!
//! One lock: a decision and what follows from it are one step, so messages leave, and are handed out, in the order in which
//! they came. A courier dials when a message of its executor has gone either way and nobody is connected.

mod courier;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use muster_api::direct::{Effect, End, Event, Line, MESSAGE_MAX, Out, Secret};
use muster_api::wire::framework::v1 as proto;
use rustls::ClientConfig;
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore, mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

use super::pending::Answered;
use crate::event::Outlet;
use crate::{CallRefused, Event as Happened};

/// Messages that wait to be written, of all executors; further callers wait for room.
const ROOM: usize = 64;

/// A message on its way to an executor.
#[derive(Debug)]
pub(crate) struct Outgoing {
    pub(crate) data: Bytes,
    /// Who sent it waits here.
    pub(crate) answered: Answered,
    /// Given back once it is written.
    pub(crate) room: OwnedSemaphorePermit,
}

/// What goes through the controller, in this order.
#[derive(Debug)]
pub(crate) enum Relayed {
    Message { executor: String, outgoing: Outgoing },
    Mark { executor: String, line: Line },
}

/// Where an agent is, and what lets the framework in there.
#[derive(Debug, Clone, PartialEq)]
struct Door {
    address: String,
    server_name: String,
    secret: Secret,
}

/// How the task of a line is told.
#[derive(Debug, Clone, Default)]
struct Reins {
    /// There is something to take.
    wake: Arc<Notify>,
    /// It has to end.
    cut: CancellationToken,
}

/// One executor's.
#[derive(Debug)]
struct Lane {
    end: End<Outgoing>,
    node: String,
    door: watch::Sender<Option<Door>>,
    /// A message went by without a line.
    wanted: Arc<Notify>,
    reins: Option<Reins>,
    _courier: AbortOnDropHandle<()>,
}

#[derive(Debug)]
struct Table {
    lanes: HashMap<String, Lane>,
    /// None: the framework has ended.
    events: Option<Outlet>,
}

#[derive(Debug)]
struct Shared {
    table: Mutex<Table>,
    to_session: mpsc::UnboundedSender<Relayed>,
    room: Arc<Semaphore>,
    tls: Arc<ClientConfig>,
}

/// All of them. Clones are the same.
#[derive(Debug, Clone)]
pub(crate) struct Lanes(Arc<Shared>);

impl Lanes {
    /// Messages of executors go to `events`; what has to go through the controller comes out of the channel.
    pub(crate) fn new(
        tls: Arc<ClientConfig>,
        events: Outlet,
    ) -> (Lanes, mpsc::UnboundedReceiver<Relayed>) {
        let (to_session, relayed) = mpsc::unbounded_channel();
        let table = Mutex::new(Table { lanes: HashMap::new(), events: Some(events) });
        let room = Arc::new(Semaphore::new(ROOM));
        (Lanes(Arc::new(Shared { table, to_session, room, tls })), relayed)
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        self.0.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends a message, and waits for what becomes of it.
    pub(crate) async fn send(&self, executor: &str, data: Bytes) -> Result<(), CallRefused> {
        if data.len() > MESSAGE_MAX {
            return Err(CallRefused::too_long(data.len()));
        }
        let room = Arc::clone(&self.0.room).acquire_owned().await;
        let room = room.map_err(|_| CallRefused::ended())?;
        let (answered, answer) = oneshot::channel();
        self.post(executor, Outgoing { data, answered, room });
        answer.await.unwrap_or_else(|_| Err(CallRefused::ended())).map(drop)
    }

    fn post(&self, executor: &str, outgoing: Outgoing) {
        let mut table = self.table();
        if table.lanes.contains_key(executor) {
            self.handle(&mut table, executor, Event::Send(outgoing));
            want(&table, executor);
        } else {
            // Under the lock: a line that opens meanwhile is marked behind it.
            self.relay(executor, outgoing);
        }
    }

    fn relay(&self, executor: &str, outgoing: Outgoing) {
        let executor = executor.to_owned();
        // Closed: the framework has ended, and the sender hears that.
        drop(self.0.to_session.send(Relayed::Message { executor, outgoing }));
    }

    /// Carries out what a lane's end decides. True: the message that came is to be handed out.
    fn handle(&self, table: &mut Table, executor: &str, event: Event<Outgoing>) -> bool {
        let Some(lane) = table.lanes.get_mut(executor) else { return false };
        let mut deliver = false;
        for effect in lane.end.handle(event) {
            match effect {
                Effect::Deliver => deliver = true,
                Effect::Relay(outgoing) => self.relay(executor, outgoing),
                Effect::Mark(line) => {
                    let executor = executor.to_owned();
                    drop(self.0.to_session.send(Relayed::Mark { executor, line }));
                }
                Effect::Wake(_) => {
                    if let Some(reins) = &lane.reins {
                        reins.wake.notify_one();
                    }
                }
                Effect::Close(_) => {
                    if let Some(reins) = lane.reins.take() {
                        reins.cut.cancel();
                    }
                }
            }
        }
        deliver
    }

    /// A message or a mark of an executor, through the controller.
    pub(crate) fn relayed(&self, message: proto::Message) {
        let mut table = self.table();
        let executor = message.executor.as_str();
        if let Some(line) = Line::new(message.mark) {
            self.handle(&mut table, executor, Event::Marked(line));
            return;
        }
        if table.lanes.contains_key(executor) {
            self.handle(&mut table, executor, Event::Relayed);
            want(&table, executor);
        }
        hand_out(&table, message);
    }

    /// A message of an executor over a line. False: the line is no more.
    fn arrived(&self, executor: &str, line: Line, data: Bytes) -> bool {
        let mut table = self.table();
        let deliver = self.handle(&mut table, executor, Event::Arrived(line));
        if let Some(lane) = table.lanes.get(executor).filter(|_| deliver) {
            let (executor, node) = (executor.to_owned(), lane.node.clone());
            hand_out(&table, proto::Message { executor, node, data, mark: 0 });
        }
        deliver
    }

    fn happened(&self, executor: &str, event: Event<Outgoing>) {
        self.handle(&mut self.table(), executor, event);
    }

    /// A courier dials. None: its executor is no more.
    fn dialled(&self, executor: &str, line: Line) -> Option<Reins> {
        let mut table = self.table();
        let reins = Reins::default();
        table.lanes.get_mut(executor)?.reins = Some(reins.clone());
        self.handle(&mut table, executor, Event::Dialled(line));
        Some(reins)
    }

    fn take(&self, executor: &str, line: Line) -> Option<Out<Outgoing>> {
        self.table().lanes.get_mut(executor)?.end.take(line)
    }

    /// Where an executor's agent is now, or that nobody may come there any more. What was connected by an earlier word goes.
    pub(crate) fn told(&self, direct: proto::Direct) {
        let proto::Direct { executor, node, address, server_name, ticket } = direct;
        let door = Secret::read(&ticket).map(|secret| Door { address, server_name, secret });
        let mut table = self.table();
        if table.events.is_none() {
            return;
        }
        let Some(lane) = table.lanes.get_mut(&executor) else {
            if door.is_some() {
                let lane = self.lane(executor.clone(), node, door);
                table.lanes.insert(executor, lane);
            }
            return;
        };
        lane.node = node;
        let changed = lane.door.send_if_modified(|present| {
            let changed = *present != door;
            *present = door;
            changed
        });
        if let Some(line) = lane.end.line().filter(|_| changed) {
            // It was wanted, and what was said of the executor next may let it in again.
            lane.wanted.notify_one();
            self.handle(&mut table, &executor, Event::Closed(line));
        }
    }

    fn lane(&self, executor: String, node: String, door: Option<Door>) -> Lane {
        let (door, doors) = watch::channel(door);
        let wanted = Arc::new(Notify::new());
        let courier = courier::run(self.clone(), executor, doors, Arc::clone(&wanted));
        let courier = AbortOnDropHandle::new(tokio::spawn(courier));
        Lane { end: End::default(), node, door, wanted, reins: None, _courier: courier }
    }

    /// An executor has ended.
    pub(crate) fn lost(&self, executor: &str) {
        let mut table = self.table();
        self.leave(&mut table, executor);
        table.lanes.remove(executor);
    }

    /// The framework has begun anew.
    pub(crate) fn forget(&self) {
        let mut table = self.table();
        let all: Vec<String> = table.lanes.keys().cloned().collect();
        for executor in all {
            self.leave(&mut table, &executor);
        }
        table.lanes.clear();
    }

    fn leave(&self, table: &mut Table, executor: &str) {
        if let Some(line) = table.lanes.get(executor).and_then(|lane| lane.end.line()) {
            self.handle(table, executor, Event::Closed(line));
        }
    }

    /// The framework has ended: who waits is told so, and nobody sends any more.
    pub(crate) fn close(&self) {
        self.0.room.close();
        self.forget();
        self.table().events = None;
    }
}

fn want(table: &Table, executor: &str) {
    if let Some(lane) = table.lanes.get(executor).filter(|lane| lane.end.line().is_none()) {
        lane.wanted.notify_one();
    }
}

fn hand_out(table: &Table, message: proto::Message) {
    if let Some(events) = &table.events {
        events.send(Happened::Message(message));
    }
}
