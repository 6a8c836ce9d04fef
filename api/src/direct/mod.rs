//! Messages between a framework and an executor that go directly between the framework and the agent. The controller says
//! who may (a ticket for one session of one framework and one executor, told to both over their sessions) and relays what
//! cannot go directly.
//!
//! ```text
//!   framework ═══ TLS 1.3, ALPN "muster-messages/1", frames ═══▶ agent ── Unix socket ── executor
//!       └──────────── session ──── controller ──── session ────────┘
//!
//!   framework ──▶ Hello(line, ticket, executor)
//!             ◀── Welcome(line)
//!   each side: a mark through the controller, behind what it has sent there before;
//!              Passed(line) over the connection when the other's mark has come;
//!              from then on what it sends goes over the connection, in frames
//!   framework ──▶ Message(n)   ◀── Taken(n) | Refused(n)
//!             ◀── Message
//! ```
//!
//! | module | holds |
//! |---|---|
//! | [`frame`] | frames: a header of 16 bytes, then the payload as it is |
//! | [`End`] | which way a message goes: the state of one end, the same at both |
//! | [`Secret`] | a ticket, which is not shown |
//!
//! **What is promised.** Messages of one direction arrive in order, each at most once, by whichever way. All of one
//! direction go one way at a time: directly after a mark has shown that nothing is left on the way through the
//! controller; through the controller after a connection ended, and the first that arrives that way makes the receiver
//! throw away what it has not read of the connection.
//!
//! **What is lost** when a connection breaks: what was begun to be written to it and was not read at the other end. A framework
//! is told so of each message (it has no `Taken` and the call fails); an executor is not, as always. What was not begun goes
//! through the controller.

mod end;
pub mod frame;
mod secret;
#[cfg(test)]
mod tests;

pub use end::{Effect, End, Event, Out};
pub use secret::{SECRET_BYTES, Secret};

use std::fmt;
use std::num::NonZeroU64;
use std::time::Duration;

/// Longest message, bytes.
pub const MESSAGE_MAX: usize = 4 << 20;

/// The protocol's name in TLS' handshake.
pub const ALPN: &[u8] = b"muster-messages/1";

/// A mark that does not come through in this time was lost with a session, or one side cannot reach the controller: the
/// connection ends, and what waited for it goes through the controller.
pub const MARK_WITHIN: Duration = Duration::from_secs(5);

/// Who dials gets as far as Welcome within this, over a bad radio link as well.
pub const OPEN_WITHIN: Duration = Duration::from_secs(10);

/// A peer that takes nothing of what is written to it for so long is gone.
pub const STUCK_AFTER: Duration = Duration::from_secs(10);

/// What the agent's certificate must be for, when a framework dials the agent of `node`. The suffix keeps a node from being
/// taken for another host that a client of the cluster's CA may know by name.
#[must_use]
pub fn server_name(node: &str) -> String {
    format!("{node}.nodes.muster.dev")
}

/// One connection, told from others of the same executor; the framework chooses it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Line(NonZeroU64);

impl Line {
    /// None: 0 stands for no connection.
    #[must_use]
    pub fn new(number: u64) -> Option<Line> {
        NonZeroU64::new(number).map(Line)
    }

    /// As it travels.
    #[must_use]
    pub fn number(self) -> u64 {
        self.0.get()
    }
}

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}
