//! A driver that is reached by a topic of ROS 1. The gate publishes the topic, and looks whether it is the only one: nobody proves
//! who he is in ROS, so whoever reaches the master or the driver can publish beside it.

use std::io;
use std::time::Duration;

use bytes::Bytes;
use muster_ros1::name::plain;
use muster_ros1::node::{MasterState, PublishOptions, Publisher};
use muster_ros1::xmlrpc::http::Uri;
use muster_ros1::{Node, NodeOptions, peer};
use tokio::sync::{mpsc, watch};

use super::hall::Input;
use super::settings::{self, Ros, Waiting};
use crate::driver::chain;

/// Between two looks who else publishes.
const LOOK: Duration = Duration::from_secs(1);

/// Messages that wait for a driver of which each command counts.
const EACH: usize = 64;

/// Drivers that are asked whom else they read. Others may subscribe too, to watch.
const ASKED: usize = 8;

/// Why it is not sure that only the gate commands a driver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Doubt {
    /// For programs.
    pub(super) reason: &'static str,
    /// For people.
    pub(super) why: String,
}

/// Where commands go.
#[derive(Debug)]
pub(super) struct To {
    publisher: Publisher<Bytes>,
    driver: Option<String>,
    waiting: Waiting,
}

impl To {
    /// One that waits for the driver gives way to what is newer, and to a stop in any case.
    pub(super) fn write(&self, body: &[u8], first: bool) {
        match first {
            true => self.publisher.publish_first(body),
            false => self.publisher.publish(body),
        }
    }

    /// Whether the driver may be given another command. Where it is not known which subscriber that is, the slowest of those who
    /// watch does not hold it up.
    pub(super) fn takes_more(&self) -> bool {
        self.is_read() || self.driver.is_none() && self.waiting == Waiting::Newest
    }

    /// Whether the driver has everything; of one on another machine: whether that has.
    pub(super) fn is_read(&self) -> bool {
        self.publisher.is_delivered(self.driver.as_deref())
    }
}

/// How it ends.
#[derive(Debug)]
pub(super) struct End {
    node: Node,
    driver: Option<String>,
    topic: String,
    callers: watch::Receiver<Vec<String>>,
    say: Say,
}

/// What becomes known of the driver.
#[derive(Debug, Clone)]
pub(super) struct Say {
    pub(super) at: usize,
    pub(super) inputs: mpsc::Sender<Input>,
}

impl Say {
    async fn say(&self, input: Input) {
        // Closed: the gate ends.
        let _ = self.inputs.send(input).await;
    }
}

/// Publishes the topic; returns when the driver reads it.
pub(super) async fn reach(
    settings: &settings::Topic,
    waiting: Waiting,
    (ros, stop): (&Ros, Bytes),
    say: Say,
) -> io::Result<(To, End)> {
    let layout = settings.layout().ok_or_else(|| {
        io::Error::new(io::ErrorKind::InvalidInput, format!("{} is not known", settings.kind))
    })?;
    let node = Node::start(ros.node(&settings.topic)).await;
    let node = node.map_err(|error| io::Error::other(chain(&error)))?;
    let options = PublishOptions {
        queue: if waiting == Waiting::Each { EACH } else { 1 },
        latch: false,
        greeting: Some(stop),
        paced: true,
    };
    let of = (*layout.description()).into();
    let publisher = node.advertise_any(&settings.topic, of, options);
    let publisher = publisher.map_err(|error| io::Error::other(chain(&error)))?;
    let driver = settings.node.as_deref().map(|name| node.resolve(name)).transpose();
    let driver = driver.map_err(|error| io::Error::other(chain(&error)))?;
    let (topic, callers) = (publisher.topic().to_owned(), publisher.callers());
    let end = End { node, driver: driver.clone(), topic, callers, say };
    end.is_there(&publisher).await;
    Ok((To { publisher, driver, waiting }, end))
}

impl End {
    fn reads(&self, callers: &[String]) -> bool {
        match &self.driver {
            Some(driver) => callers.contains(driver),
            None => !callers.is_empty(),
        }
    }

    /// Returns when the driver reads, or does not.
    async fn until(&self, reads: bool) {
        let mut callers = self.callers.clone();
        // Closed: never, the node has its sender.
        drop(callers.wait_for(|callers| self.reads(callers) == reads).await);
    }

    async fn is_there(&self, publisher: &Publisher<Bytes>) {
        loop {
            if tokio::time::timeout(LOOK, self.until(true)).await.is_ok() {
                let why = format!("it was not looked yet who else publishes {}", self.topic);
                let doubt = Doubt { reason: "Starting", why };
                self.say.say(Input::DriverShared(self.say.at, Some(doubt))).await;
                return;
            }
            // One that was told of another publisher instead is told of this one again.
            publisher.announce();
            self.say.say(Input::DriverGone(self.say.at, self.missing())).await;
        }
    }

    fn missing(&self) -> String {
        let master = match &*self.node.state().borrow() {
            MasterState::Gone { why } => format!("; the ROS master does not answer: {why}"),
            MasterState::Unknown | MasterState::Registered => String::new(),
        };
        match &self.driver {
            Some(driver) => format!("{driver} does not subscribe {}{master}", self.topic),
            None => format!("nobody subscribes {}{master}", self.topic),
        }
    }

    /// Returns when the driver is gone.
    pub(super) async fn gone(&self) -> io::Error {
        // Neither is polled again after the other has ended.
        tokio::select! {
            () = self.until(false) => {}
            () = self.watch() => {}
        }
        io::Error::other(self.missing())
    }

    /// Says who else commands the driver, for as long as it is there.
    async fn watch(&self) {
        let mut looks = tokio::time::interval(LOOK);
        looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            looks.tick().await;
            let doubt = self.look().await;
            self.say.say(Input::DriverShared(self.say.at, doubt)).await;
        }
    }

    async fn look(&self) -> Option<Doubt> {
        let (master, topic) = (self.node.master(), &self.topic);
        let state = match master.system_state().await {
            Ok(state) => state,
            Err(error) => {
                let error = chain(&error);
                let why = format!("whether others publish {topic} is not known: {error}");
                return Some(Doubt { reason: "NoMaster", why });
            }
        };
        let publishers = state.publishers.into_iter().find(|(name, _)| name == topic);
        let mut others = publishers.map(|(_, nodes)| nodes).unwrap_or_default();
        others.retain(|node| node != self.node.name());
        if !others.is_empty() {
            let why = format!("{topic} is published by {} as well", others.join(", "));
            return Some(Doubt { reason: "OtherPublisher", why });
        }
        let mut readers = self.callers.borrow().clone();
        readers.retain(|reader| self.driver.as_ref().is_none_or(|driver| driver == reader));
        readers.sort();
        readers.dedup();
        for reader in readers.iter().take(ASKED) {
            match self.others_of(reader).await {
                Ok(others) if others.is_empty() => {}
                Ok(others) => {
                    let why = format!("{reader} reads {topic} from {} as well", others.join(", "));
                    return Some(Doubt { reason: "OtherPublisher", why });
                }
                Err(error) => {
                    let why = format!("{reader} does not say whose {topic} it reads: {error}");
                    return Some(Doubt { reason: "DriverSilent", why });
                }
            }
        }
        None
    }

    /// The publishers of the topic that a node reads, beside this one. The master need not know them: a node reads whom it
    /// was told to. One that does not read from this one has only lent its name to whoever does.
    async fn others_of(&self, reader: &str) -> Result<Vec<String>, String> {
        let uri = self.node.master().lookup_node(reader).await.map_err(|e| chain(&e))?;
        let uri: Uri = uri.parse().map_err(|error| chain(&error))?;
        let links = peer::links(&uri, self.node.name()).await.map_err(|e| chain(&e))?;
        let ours = |peer: &str| peer.parse().is_ok_and(|peer: Uri| peer == *self.node.api());
        let read = links.into_iter().filter(|l| l.incoming && l.topic == self.topic);
        let (ours, others): (Vec<_>, Vec<_>) =
            read.map(|link| link.peer).partition(|peer| ours(peer));
        match ours.is_empty() {
            true => Err(format!("it does not read from {}", self.node.name())),
            false => Ok(others),
        }
    }

    /// Publishes no more.
    pub(super) async fn now(self) {
        self.node.shut_down().await;
    }
}

impl Ros {
    fn node(&self, topic: &str) -> NodeOptions {
        let (robot, topic) = (plain(&self.robot), plain(topic.trim_matches('/')));
        NodeOptions {
            name: format!("muster_gate_{robot}_{topic}"),
            master: Some(self.master.clone()),
            host: self.host.clone(),
            namespace: self.namespace.clone(),
            // It stands between tasks and the driver: nobody ends it by a call.
            stays: true,
            ..NodeOptions::default()
        }
    }
}
