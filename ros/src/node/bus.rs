//! Every connection of a node, as `rosnode info` shows them.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, Weak};

use super::lock;
use crate::xmlrpc::Value;

/// Which way messages go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Direction {
    In,
    Out,
}

/// One connection; it is gone from the bus when its task drops it.
#[derive(Debug)]
pub(crate) struct Connection {
    id: u64,
    topic: String,
    /// Of an outgoing one the subscriber's name, of an incoming one the publisher's address.
    peer: String,
    direction: Direction,
    connected: AtomicBool,
    bytes: AtomicU64,
    messages: AtomicU64,
}

impl Connection {
    pub(crate) fn set_connected(&self, connected: bool) {
        self.connected.store(connected, Ordering::Relaxed);
    }

    pub(crate) fn passed(&self, bytes: usize) {
        self.bytes.fetch_add(bytes as u64, Ordering::Relaxed);
        self.messages.fetch_add(1, Ordering::Relaxed);
    }

    fn is_connected(&self) -> bool {
        self.connected.load(Ordering::Relaxed)
    }
}

#[derive(Debug, Default)]
pub(crate) struct Bus {
    next: AtomicU64,
    all: Mutex<BTreeMap<u64, Weak<Connection>>>,
}

/// XML-RPC has no larger integers.
fn int(number: u64) -> Value {
    Value::Int(i32::try_from(number).unwrap_or(i32::MAX))
}

impl Bus {
    pub(crate) fn add(&self, direction: Direction, topic: &str, peer: &str) -> Arc<Connection> {
        let id = self.next.fetch_add(1, Ordering::Relaxed);
        let connection = Arc::new(Connection {
            id,
            topic: topic.to_owned(),
            peer: peer.to_owned(),
            direction,
            connected: AtomicBool::new(false),
            bytes: AtomicU64::new(0),
            messages: AtomicU64::new(0),
        });
        lock(&self.all).insert(id, Arc::downgrade(&connection));
        connection
    }

    fn connections(&self) -> Vec<Arc<Connection>> {
        let mut all = lock(&self.all);
        all.retain(|_, connection| connection.strong_count() > 0);
        all.values().filter_map(Weak::upgrade).collect()
    }

    /// `getBusInfo`: id, peer, direction, transport, topic, connected, text.
    pub(crate) fn info(&self) -> Value {
        let row = |c: &Arc<Connection>| {
            let (direction, way) = match c.direction {
                Direction::In => ("i", "from"),
                Direction::Out => ("o", "to"),
            };
            let text = format!("TCPROS connection {way} {}", c.peer);
            let row: Vec<Value> = vec![
                int(c.id),
                (&*c.peer).into(),
                direction.into(),
                "TCPROS".into(),
                (&*c.topic).into(),
                c.is_connected().into(),
                text.into(),
            ];
            Value::Array(row)
        };
        Value::Array(self.connections().iter().map(row).collect())
    }

    /// `getBusStats`: publications, subscriptions, services.
    pub(crate) fn stats(&self) -> Value {
        let all = self.connections();
        let of = |direction| {
            let mut topics: BTreeMap<&str, (u64, Vec<Value>)> = BTreeMap::new();
            for c in all.iter().filter(|c| c.direction == direction) {
                let (bytes, messages) =
                    (c.bytes.load(Ordering::Relaxed), c.messages.load(Ordering::Relaxed));
                let row = match direction {
                    Direction::Out => {
                        vec![int(c.id), int(bytes), int(messages), c.is_connected().into()]
                    }
                    // What was dropped before it was sent is not known here.
                    Direction::In => {
                        vec![int(c.id), int(bytes), Value::Int(-1), c.is_connected().into()]
                    }
                };
                let (sum, rows) = topics.entry(&c.topic).or_default();
                *sum += bytes;
                rows.push(Value::Array(row));
            }
            let row = |(topic, (bytes, rows)): (&str, (u64, Vec<Value>))| match direction {
                Direction::Out => Value::Array(vec![topic.into(), int(bytes), rows.into()]),
                Direction::In => Value::Array(vec![topic.into(), rows.into()]),
            };
            Value::Array(topics.into_iter().map(row).collect())
        };
        Value::Array(vec![of(Direction::Out), of(Direction::In), Value::Array(Vec::new())])
    }
}
