//! What is asked of the desk, and where what it says goes.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use muster_api::id::TaskUid;
use muster_api::kind::framework::FrameworkSpec;
use muster_api::kind::task::{NodeRefusal, TaskSpec};
use muster_api::wire::framework::v1 as wire;
use muster_controller_core::offer::OfferId;
use serde_json::Value;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use crate::auth::Identity;
use crate::quota::Pass;
use crate::store::{Key, Op};

/// Uid of a Framework object: the id of the framework.
pub type FrameworkUid = Arc<str>;

/// Where what a framework is told goes.
#[derive(Debug, Clone)]
pub struct Outlet {
    /// Tells this session from a later one of the same framework.
    pub(super) session: u64,
    events: mpsc::Sender<wire::Event>,
    /// Cancelled when the framework does not read what it is told.
    cut: CancellationToken,
    /// Bytes of executors' messages that wait in `events`.
    relayed: Arc<AtomicUsize>,
}

/// Most bytes of executors' messages that wait for one framework: some of the largest. Past it they are lost, as they are while
/// it is away; offers and updates are not, and the session stands.
const MAX_RELAYED: usize = 16 << 20;

impl Outlet {
    /// An outlet of a session into `events`; `cut` ends the session.
    #[must_use]
    pub fn new(session: u64, events: mpsc::Sender<wire::Event>, cut: CancellationToken) -> Self {
        Outlet { session, events, cut, relayed: Arc::default() }
    }

    /// The session's number.
    #[must_use]
    pub fn session(&self) -> u64 {
        self.session
    }

    /// Passes an executor's message on; false: the framework does not keep up, and it is lost. Never waits, and cuts nobody off.
    #[must_use]
    pub fn relay(&self, message: wire::Message) -> bool {
        // The other half is for what a session may not lose.
        if self.events.capacity() < self.events.max_capacity() / 2 {
            return false;
        }
        let bytes = message.data.len();
        if self.relayed.fetch_add(bytes, Ordering::Relaxed) + bytes > MAX_RELAYED {
            self.relayed.fetch_sub(bytes, Ordering::Relaxed);
            return false;
        }
        let event = wire::Event { event: Some(wire::event::Event::Message(message)) };
        let sent = self.events.try_send(event).is_ok();
        if !sent {
            self.relayed.fetch_sub(bytes, Ordering::Relaxed);
        }
        sent
    }

    /// The event has left the outlet.
    pub fn taken(&self, event: &wire::Event) {
        if let Some(wire::event::Event::Message(message)) = &event.event
            && message.mark == 0
        {
            self.relayed.fetch_sub(message.data.len(), Ordering::Relaxed);
        }
    }

    /// Says it, or cuts the session off when it does not read. Never waits.
    pub fn say(&self, event: wire::event::Event) {
        let event = wire::Event { event: Some(event) };
        if let Err(mpsc::error::TrySendError::Full(_)) = self.events.try_send(event) {
            self.cut.cancel();
        }
    }
}

/// What a session asks of the desk.
#[derive(Debug)]
pub enum Request {
    /// A framework is there.
    Subscribe {
        /// Who.
        uid: FrameworkUid,
        /// Its namespace and name.
        key: Key,
        /// What it wants.
        spec: Box<FrameworkSpec>,
        /// Where it hears.
        outlet: Outlet,
    },
    /// It wants something else.
    Wish {
        /// Who.
        uid: FrameworkUid,
        /// What.
        spec: Box<FrameworkSpec>,
        /// Told after what was offered for the old wish is rescinded.
        done: oneshot::Sender<()>,
    },
    /// Offers of everything, again.
    Revive {
        /// Who.
        uid: FrameworkUid,
    },
    /// No offers.
    Suppress {
        /// Who.
        uid: FrameworkUid,
    },
    /// Not these.
    Decline {
        /// Who.
        uid: FrameworkUid,
        /// Which.
        offers: Vec<OfferId>,
        /// For how long.
        refuse: Duration,
    },
    /// Launches.
    Accept {
        /// Who.
        uid: FrameworkUid,
        /// The session's number: what comes of it is that session's.
        session: u64,
        /// Who opened the session.
        by: Arc<Identity>,
        /// The call's own id, for the Answer.
        call: String,
        /// Which offers it answers.
        offers: Vec<OfferId>,
        /// What is to run.
        launches: Vec<Prepared>,
        /// For how long the rest of the nodes is not wanted.
        refuse: Duration,
        /// That the namespace is still there when it is written.
        guard: Option<Op>,
    },
    /// Its session ended. Ignored when a newer one has subscribed.
    Leave {
        /// Who.
        uid: FrameworkUid,
        /// The session's number.
        session: u64,
    },
    /// It is gone for good.
    Remove {
        /// Who.
        uid: FrameworkUid,
    },
    /// What is offered to whom.
    Look {
        /// Each offer, or only their number.
        depth: Depth,
        /// Where the answer goes.
        answer: oneshot::Sender<Vec<View>>,
    },
    /// Why each node is not offered to a framework.
    Why {
        /// Who.
        uid: FrameworkUid,
        /// Where the answer goes; none: it is not at the desk.
        answer: oneshot::Sender<Option<Vec<NodeRefusal>>>,
    },
}

/// How closely one looks at what is offered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Depth {
    /// How many offers each framework has.
    Numbers,
    /// Each offer.
    Offers,
}

/// A task that only needs its node.
#[derive(Debug)]
pub struct Prepared {
    /// Its key.
    pub key: Key,
    /// The whole object, admitted and stamped, without a status.
    pub object: Value,
    /// Its spec.
    pub spec: TaskSpec,
    /// Its uid.
    pub uid: TaskUid,
    /// The offer it uses.
    pub offer: OfferId,
    /// Through its namespace's quota; kept until it is written or refused.
    pub(crate) _pass: Option<Pass>,
}

/// One framework as the desk sees it.
#[derive(Debug, Clone, serde::Serialize)]
#[serde(rename_all = "camelCase")]
pub struct View {
    /// Its object's uid.
    #[serde(serialize_with = "text")]
    pub uid: FrameworkUid,
    /// Its namespace.
    pub namespace: String,
    /// Its name.
    pub name: String,
    /// A session is open.
    pub connected: bool,
    /// It wants no offers.
    pub suppressed: bool,
    /// Weighted dominant share of its namespace.
    pub share: f64,
    /// How many offers it has.
    #[serde(skip)]
    pub offered: usize,
    /// What it is offered; empty when only numbers were asked for.
    pub offers: Vec<OfferView>,
}

fn text<S: serde::Serializer>(uid: &FrameworkUid, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(uid)
}

/// One offer.
#[derive(Debug, Clone, serde::Serialize)]
#[serde(rename_all = "camelCase")]
pub struct OfferView {
    /// Its number.
    pub id: String,
    /// The node.
    pub node: String,
    /// Metres or seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub score: Option<f64>,
    /// Milliseconds since it was made.
    pub age_ms: u64,
    /// Free CR that it shows.
    pub free: muster_api::resource::Compute,
    /// The robot's actuators are free.
    pub actuators: bool,
    /// How many other frameworks are shown the node.
    pub shared_with: usize,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_that_are_not_read_are_lost_and_the_session_stands() {
        let ((events, mut heard), cut) = (mpsc::channel(64), CancellationToken::new());
        let outlet = Outlet::new(1, events, cut.clone());
        let message =
            || wire::Message { data: vec![0; 4 << 20].into(), ..wire::Message::default() };
        let passed = (0..8).filter(|_| outlet.relay(message())).count();
        assert_eq!(passed, MAX_RELAYED / (4 << 20));
        outlet.say(wire::event::Event::Heartbeat(wire::Heartbeat {}));
        outlet.taken(&heard.try_recv().expect("a message"));
        assert!(outlet.relay(message()), "there is room again");
        assert!(!outlet.relay(message()));
        assert!(!cut.is_cancelled());
    }

    #[test]
    fn many_small_messages_leave_room_for_what_a_session_may_not_lose() {
        let ((events, _heard), cut) = (mpsc::channel(64), CancellationToken::new());
        let outlet = Outlet::new(1, events, cut.clone());
        let passed = (0..64).filter(|_| outlet.relay(wire::Message::default())).count();
        assert!((32..=33).contains(&passed), "{passed}");
        for _ in 0..31 {
            outlet.say(wire::event::Event::Heartbeat(wire::Heartbeat {}));
        }
        assert!(!cut.is_cancelled());
    }
}
