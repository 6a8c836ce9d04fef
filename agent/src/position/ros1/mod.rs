//! Poses from a ROS 1 topic: `nav_msgs/Odometry`, `PoseWithCovarianceStamped`, `PoseStamped`, or transforms.
//!
//! ```text
//!   topic, its _static ──▶ read ──▶ Tracker ─┐
//!   /clock ──▶ RosClock ─────────────────────┴─▶ judge ──▶ Seen     at each message, and every tenth of a second
//! ```
//!
//! What is decided is decided in `muster_agent_core::pose`; here it is fetched. The topic's type is its publisher's: it is
//! read from the connection, and a publisher of another type may follow.

mod clock;
mod read;

use std::time::Duration;

use muster_agent_core::pose::judge::{self, Source};
use muster_agent_core::pose::tracker::Tracker;
use muster_ros1::name::plain;
use muster_ros1::node::{Incoming, MasterState, SubscribeOptions, Subscriber};
use muster_ros1::{Node, NodeOptions};
use tokio::sync::watch;
use tokio::time::MissedTickBehavior;
use tokio_util::task::AbortOnDropHandle;

use self::clock::RosClock;
use self::read::Read;
use super::settings::PoseSettings;
use super::{Position, Seen};
use crate::driver::chain;

/// A pose grows old without anybody saying so.
const LOOK: Duration = Duration::from_millis(100);
/// Before a node that was told to end is started again: whoever ended it may have meant it for now.
const REST: Duration = Duration::from_secs(5);
/// Transforms of all joints of a robot come in messages of their own.
const QUEUE: usize = 256;

/// What the task needs.
#[derive(Debug, Clone)]
struct Reader {
    topic: String,
    map: String,
    settings: PoseSettings,
    /// The name of the agent's node in ROS.
    node: String,
}

pub(super) fn open(topic: &str, map: &str, name: &str, settings: &PoseSettings) -> Position {
    let (say, newest) = watch::channel(Seen::default());
    let reader = Reader {
        topic: topic.to_owned(),
        map: map.to_owned(),
        settings: settings.clone(),
        node: node_name(name),
    };
    let source = tokio::spawn(reader.run(say));
    Position { newest, _source: Some(AbortOnDropHandle::new(source)) }
}

/// The same after each start, so that the master forgets the one before. Names of nodes have dashes and dots, ROS's not.
fn node_name(node: &str) -> String {
    format!("muster_agent_{}", plain(node))
}

impl Reader {
    async fn run(self, say: watch::Sender<Seen>) {
        let mut tracker = Tracker::new(self.settings.frames.clone(), self.settings.map_to_odom);
        let clock = RosClock::default();
        loop {
            let why = match self.start().await {
                Ok(node) => self.follow(&node, &mut tracker, &say).await,
                Err(why) => why,
            };
            tracing::warn!(topic = self.topic, why, "poses are not read from ROS; trying again");
            let again = tokio::time::Instant::now() + REST;
            while tokio::time::Instant::now() < again {
                let down = Source::Down { why: why.clone() };
                self.tell(&say, (&tracker, &clock), &down, judge::MAX_AGE);
                tokio::time::sleep(LOOK).await;
            }
        }
    }

    async fn start(&self) -> Result<Node, String> {
        let options = NodeOptions {
            name: self.node.clone(),
            master: self.settings.master.clone(),
            host: self.settings.host.clone(),
            namespace: self.settings.namespace.clone(),
            ..NodeOptions::default()
        };
        Node::start(options).await.map_err(|error| chain(&error))
    }

    /// Until the node is to end: why.
    async fn follow(
        &self,
        node: &Node,
        tracker: &mut Tracker,
        say: &watch::Sender<Seen>,
    ) -> String {
        let options = || SubscribeOptions { queue: QUEUE, ..SubscribeOptions::default() };
        let mut topic = match node.subscribe_any(&self.topic, options()) {
            Ok(topic) => topic,
            Err(error) => return chain(&error),
        };
        let mut fixed: Option<Subscriber<Incoming>> = None;
        let mut clock = match RosClock::open(node) {
            Ok(clock) => clock,
            Err(error) => return chain(&error),
        };
        let (mut other, mut max_age) = (None, judge::MAX_AGE);
        let mut looks = tokio::time::interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let ended = node.ended();
        tokio::pin!(ended);
        loop {
            // Cancel safe: queues, a watch, a tick.
            tokio::select! {
                why = &mut ended => return why,
                incoming = topic.next() => {
                    let read = read::read(&incoming);
                    max_age = read.as_ref().map_or(max_age, Read::max_age);
                    other = other_type(&read, &incoming, topic.topic());
                    if fixed.is_none() && matches!(read, Ok(Read::Told(_))) {
                        fixed = node.subscribe_any(&format!("{}_static", topic.topic()), options()).ok();
                    }
                    take(tracker, read, false, &clock);
                }
                incoming = next(&mut fixed) => take(tracker, read::read(&incoming), true, &clock),
                () = clock.follow(node) => {}
                _ = looks.tick() => {}
            }
            let source = source(node, &topic, &other);
            self.tell(say, (tracker, &clock), &source, max_age);
        }
    }

    fn tell(
        &self,
        say: &watch::Sender<Seen>,
        (tracker, clock): (&Tracker, &RosClock),
        source: &Source,
        max_age: Duration,
    ) {
        let name = format!("ros1:{}", self.topic);
        let limits = self.settings.limits(max_age);
        let standing = judge::judge(tracker, source, &clock.clocks(), &limits, (&self.map, &name));
        let seen = Seen {
            pose: standing.pose,
            fresh: Some(standing.fresh),
            localized: standing.localized,
        };
        say.send_if_modified(|old| {
            let changed = *old != seen;
            if old.localized.holds != seen.localized.holds {
                let verdict = &seen.localized;
                tracing::info!(
                    localized = verdict.holds,
                    reason = verdict.reason,
                    why = verdict.message,
                    "the robot's place"
                );
            }
            *old = seen;
            changed
        });
    }
}

async fn next(fixed: &mut Option<Subscriber<Incoming>>) -> Incoming {
    match fixed {
        Some(fixed) => fixed.next().await,
        None => std::future::pending().await,
    }
}

fn take(
    tracker: &mut Tracker,
    read: Result<Read, read::ReadError>,
    are_static: bool,
    clock: &RosClock,
) {
    match read {
        Ok(Read::Said(kind, said)) => tracker.say(kind, &said, &clock.clocks()),
        Ok(Read::Told(told)) => tracker.tell(&told, are_static, &clock.clocks()),
        Err(error) => tracing::debug!(error = chain(&error), "a message was not read"),
    }
}

/// The type of a topic that tells no place.
fn other_type(
    read: &Result<Read, read::ReadError>,
    incoming: &Incoming,
    topic: &str,
) -> Option<Source> {
    match read {
        Ok(_) => None,
        Err(read::ReadError::Type) => {
            Some(Source::OtherType { topic: topic.to_owned(), kind: incoming.from.kind.clone() })
        }
        Err(error) => Some(Source::Unreachable { topic: topic.to_owned(), why: chain(error) }),
    }
}

/// How it stands with the topic. A connection outlives the master that arranged it.
fn source(node: &Node, topic: &Subscriber<Incoming>, other: &Option<Source>) -> Source {
    let (status, name) = (topic.status(), || topic.topic().to_owned());
    if status.connected > 0 {
        return other.clone().unwrap_or(Source::Connected);
    }
    match (&*node.state().borrow(), status.trouble) {
        (MasterState::Gone { why }, _) => Source::NoMaster { why: why.clone() },
        (_, Some(why)) => Source::Unreachable { topic: name(), why },
        (MasterState::Unknown, None) => Source::NoMaster { why: "it was not asked yet".to_owned() },
        (MasterState::Registered, None) => Source::NoPublisher { topic: name() },
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_nodes_name_becomes_one_of_ros() {
        assert_eq!(super::node_name("turtlebot-1.lab"), "muster_agent_turtlebot_1_lab");
    }
}
