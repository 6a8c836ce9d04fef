//! The network between agents, frameworks and the controller: connections that keep the order of what they carry, as TCP does, and lose
//! it from some moment on, or hold it for any time. Messages of an older connection may come after those of a newer one.

use std::collections::{BTreeMap, VecDeque};

use muster_api::wire::agent::v1 as wire;
use muster_api::wire::framework::v1 as framework;

use crate::agenda::{Agenda, Due};
use crate::dice::Dice;

/// What decides how long something takes, and where it is put.
type Chance<'a> = (&'a mut Dice, &'a mut Agenda);

/// A connection. Numbers are never used twice.
pub(crate) type Conn = u64;

/// What a connection carries to the controller.
#[derive(Debug, Clone)]
pub(crate) enum Up {
    Open,
    /// An agent wants to hear what people order.
    Orders,
    Message(Box<wire::AgentMessage>),
    Call(Box<framework::Call>),
    End,
}

/// What a connection carries to the agent or the framework.
#[derive(Debug, Clone)]
pub(crate) enum Down {
    Message(Box<wire::ControllerMessage>),
    Event(Box<framework::Event>),
    Order(wire::NodeOrder),
    End,
}

/// One direction of a connection: the oldest of what is under way arrives first, whatever happens meanwhile.
#[derive(Debug)]
struct Way<T> {
    under_way: VecDeque<T>,
    /// When the last of it arrives.
    last: u64,
    /// So many would have arrived, and something is in the way.
    held: usize,
}

impl<T> Default for Way<T> {
    fn default() -> Self {
        Way { under_way: VecDeque::new(), last: 0, held: 0 }
    }
}

impl<T> Way<T> {
    fn send(&mut self, what: T, at: u64) -> u64 {
        self.under_way.push_back(what);
        self.last = self.last.max(at);
        self.last
    }

    fn arrives(&mut self, blocked: bool) -> Option<T> {
        if blocked {
            self.held += 1;
            return None;
        }
        self.under_way.pop_front()
    }
}

#[derive(Debug)]
struct Line {
    node: usize,
    up: Way<Up>,
    down: Way<Down>,
    /// Nothing arrives any more, and nobody is told.
    black: bool,
}

/// Every connection, and who cannot reach whom.
#[derive(Debug, Default)]
pub(crate) struct Net {
    lines: BTreeMap<Conn, Line>,
    next: Conn,
    /// By end, first the nodes and then the frameworks: nothing of it reaches the controller; nothing of the controller reaches it.
    blocked: Vec<(bool, bool)>,
    /// The longest time on the way, milliseconds.
    pub(crate) slowest: u64,
    pub(crate) carried: u64,
}

impl Net {
    pub(crate) fn new(ends: usize) -> Net {
        Net { blocked: vec![(false, false); ends], slowest: 5, next: 1, ..Net::default() }
    }

    pub(crate) fn is_blocked(&self, node: usize) -> bool {
        self.blocked[node].0 || self.blocked[node].1
    }

    pub(crate) fn open(&mut self, node: usize) -> Conn {
        let conn = self.next;
        self.next += 1;
        let line = Line { node, up: Way::default(), down: Way::default(), black: false };
        self.lines.insert(conn, line);
        conn
    }

    /// Both ends know that it is over.
    pub(crate) fn forget(&mut self, conn: Conn) {
        self.lines.remove(&conn);
    }

    pub(crate) fn node_of(&self, conn: Conn) -> Option<usize> {
        self.lines.get(&conn).map(|line| line.node)
    }

    /// Every connection.
    pub(crate) fn all(&self) -> Vec<Conn> {
        self.lines.keys().copied().collect()
    }

    pub(crate) fn send_up(&mut self, conn: Conn, what: Up, now: u64, (dice, agenda): Chance<'_>) {
        let at = now + dice.between(0, self.slowest);
        if let Some(line) = self.lines.get_mut(&conn) {
            agenda.at(line.up.send(what, at), Due::Up(conn));
        }
    }

    pub(crate) fn send_down(
        &mut self,
        conn: Conn,
        what: Down,
        now: u64,
        (dice, agenda): Chance<'_>,
    ) {
        let at = now + dice.between(0, self.slowest);
        if let Some(line) = self.lines.get_mut(&conn) {
            agenda.at(line.down.send(what, at), Due::Down(conn));
        }
    }

    /// What arrives at the controller now, if nothing is in the way.
    pub(crate) fn arrives_up(&mut self, conn: Conn) -> Option<Up> {
        let line = self.lines.get_mut(&conn).filter(|line| !line.black)?;
        self.carried += 1;
        line.up.arrives(self.blocked[line.node].0)
    }

    /// What arrives at the agent now, if nothing is in the way.
    pub(crate) fn arrives_down(&mut self, conn: Conn) -> Option<Down> {
        let line = self.lines.get_mut(&conn).filter(|line| !line.black)?;
        self.carried += 1;
        line.down.arrives(self.blocked[line.node].1)
    }

    pub(crate) fn block(&mut self, node: usize, up: bool, down: bool) {
        self.blocked[node].0 |= up;
        self.blocked[node].1 |= down;
    }

    /// What was held goes on, in order.
    pub(crate) fn heal(&mut self, node: usize, now: u64, (dice, agenda): Chance<'_>) {
        self.blocked[node] = (false, false);
        for (conn, line) in self.lines.iter_mut().filter(|(_, line)| line.node == node) {
            for _ in 0..std::mem::take(&mut line.up.held) {
                agenda.at(now + dice.between(0, self.slowest), Due::Up(*conn));
            }
            for _ in 0..std::mem::take(&mut line.down.held) {
                agenda.at(now + dice.between(0, self.slowest), Due::Down(*conn));
            }
        }
    }

    /// Whether nothing can pass.
    pub(crate) fn is_dead(&self, conn: Conn) -> bool {
        self.lines.get(&conn).is_some_and(|line| line.black || self.is_blocked(line.node))
    }

    /// From now on nothing of the connection arrives, and neither end is told.
    pub(crate) fn black_out(&mut self, conn: Conn) {
        if let Some(line) = self.lines.get_mut(&conn) {
            line.black = true;
        }
    }
}
