//! A node: what it subscribes and publishes, and what it needs for that.
//!
//! | module | is |
//! |---|---|
//! | `registrar` | one task: keeps the master's knowledge of this node as it should be |
//! | `slave` | the API that the master and other nodes call |
//! | `subscription` | a task a topic, and one below it for each publisher: `link` |
//! | `publication` | a task for all who connect, and one for each subscriber |
//! | `outbox` | what waits for one subscriber |
//! | `unread` | what it was sent and has not read |
//! | `bus` | every connection, for `rosnode info` |

mod bus;
mod link;
mod outbox;
mod publication;
mod registrar;
mod slave;
mod subscription;
mod unread;

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use tokio::net::TcpListener;
use tokio::sync::{Notify, watch};
use tokio_util::task::AbortOnDropHandle;

pub use publication::{PublishOptions, Publisher};
pub use registrar::MasterState;
pub use subscription::{
    Arrivals, From, Incoming, SubscribeOptions, Subscriber, Subscription, SubscriptionStatus,
};

use crate::env::{self, Environment};
use crate::master::Master;
use crate::message::{Message, Type, describe};
use crate::name::{NameError, Resolver};
use crate::pace::Pace;
use crate::xmlrpc::Value;
use crate::xmlrpc::http::{Uri, UriError, serve};
use bus::Bus;
use publication::Publication;

/// Taking back what was registered may take this long; a master that is gone has nothing to take back.
const FAREWELL: Duration = Duration::from_secs(2);

/// How a node is started.
#[derive(Debug, Clone, Default)]
pub struct NodeOptions {
    /// The node's own name, without its namespace.
    pub name: String,
    /// `http://HOST:PORT`; absent: the environment's, else `http://localhost:11311`.
    pub master: Option<String>,
    /// Under what name or address others reach this node; absent: the environment's, else the address of the interface
    /// that leads to the master.
    pub host: Option<String>,
    /// Absent: the environment's, else the root.
    pub namespace: Option<String>,
    /// Names that are replaced: from, to.
    pub remappings: Vec<(String, String)>,
    /// Whoever wants this node to end (anybody may say so) is refused.
    pub stays: bool,
    /// How often others may call it; none: as often as they like.
    pub pace: Option<Pace>,
}

/// Why a node does not start, or does not take a topic.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// A name is none.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The master's address is none.
    #[error(transparent)]
    Master(#[from] UriError),
    /// No port can be had.
    #[error("failed to listen for ROS on {host}")]
    Listen {
        /// Where.
        host: String,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The node has this topic already.
    #[error("this node {what} {topic} already")]
    Twice {
        /// `subscribes` or `publishes`.
        what: &'static str,
        /// The topic.
        topic: String,
    },
}

/// What all parts of a node know.
#[derive(Debug)]
pub(crate) struct Shared {
    /// The node's global name.
    name: String,
    master: Master,
    /// Where the slave API is.
    api: Uri,
    /// Where publications are taken from.
    data: Uri,
    topics: Mutex<Topics>,
    bus: Bus,
    /// There is something for the registrar to do.
    work: Notify,
    /// Held while the master is asked. Who takes back what is registered has it first: a master answers connections side by
    /// side, and a registration that was under way could come after.
    turn: tokio::sync::Mutex<()>,
    state: watch::Sender<MasterState>,
    /// Nobody may end it from afar.
    stays: bool,
    /// Why somebody wanted this node to end.
    ended: watch::Sender<Option<String>>,
}

/// What is wanted.
#[derive(Debug, Default)]
struct Topics {
    subscriptions: BTreeMap<String, Arc<Subscription>>,
    publications: BTreeMap<String, Arc<Publication>>,
    params: BTreeMap<String, Arc<Param>>,
    /// Not wanted any more, and perhaps still registered.
    leaving: BTreeSet<Leaving>,
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Leaving {
    Subscription(String),
    Publication(String),
    Param(String),
}

/// A parameter that is followed.
#[derive(Debug)]
pub(crate) struct Param {
    value: watch::Sender<Option<Value>>,
    registered: Mutex<bool>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Nobody panics within: what is behind is whole.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    fn topics(&self) -> MutexGuard<'_, Topics> {
        lock(&self.topics)
    }

    fn leave(&self, what: Leaving) {
        self.leave_from(&mut self.topics(), what);
    }

    fn leave_from(&self, topics: &mut Topics, what: Leaving) {
        match &what {
            Leaving::Subscription(topic) => drop(topics.subscriptions.remove(topic)),
            Leaving::Publication(topic) => drop(topics.publications.remove(topic)),
            Leaving::Param(key) => drop(topics.params.remove(key)),
        }
        topics.leaving.insert(what);
        self.work.notify_one();
    }
}

/// A node of a ROS 1 graph. When it is dropped, its connections end; [`Node::shut_down`] tells the master as well.
#[derive(Debug)]
pub struct Node {
    shared: Arc<Shared>,
    names: Resolver,
    tasks: Vec<AbortOnDropHandle<()>>,
}

impl Node {
    /// Starts a node. The master need not be there: the node registers when it is, and again after each restart.
    ///
    /// # Errors
    ///
    /// A setting makes no sense, or no port can be had.
    pub async fn start(options: NodeOptions) -> Result<Node, NodeError> {
        let environment = Environment::read();
        let master = options.master.or(environment.master);
        let master: Uri = master.as_deref().unwrap_or(env::DEFAULT_MASTER).parse()?;
        let namespace = options.namespace.or(environment.namespace).unwrap_or_default();
        let rules = options.remappings.iter().map(|(from, to)| (&**from, &**to));
        let names = Resolver::new(&namespace, &options.name, rules)?;
        let host = match options.host.or(environment.host) {
            Some(host) => host,
            None => own_address(&master).await,
        };
        let listen = async || {
            let there = host.clone();
            // Resolving a name blocks.
            let at = tokio::task::spawn_blocking(move || env::listen_at(&there)).await;
            let listener =
                TcpListener::bind(at.unwrap_or_else(|_| ([0, 0, 0, 0], 0).into())).await?;
            let port = listener.local_addr()?.port();
            io::Result::Ok((listener, Uri { host: host.clone(), port }))
        };
        let failed = |source| NodeError::Listen { host: host.clone(), source };
        let (calls, api) = listen().await.map_err(failed)?;
        let (subscribers, data) = listen().await.map_err(failed)?;
        let shared = Arc::new(Shared {
            name: names.node().to_owned(),
            master: Master::new(master, names.node()),
            api,
            data,
            topics: Mutex::default(),
            bus: Bus::default(),
            work: Notify::new(),
            turn: tokio::sync::Mutex::new(()),
            state: watch::Sender::new(MasterState::Unknown),
            stays: options.stays,
            ended: watch::Sender::new(None),
        });
        let slave = Arc::new(slave::Slave(Arc::clone(&shared)));
        let tasks = [
            tokio::spawn(serve(calls, slave, options.pace)),
            tokio::spawn(publication::serve(subscribers, Arc::clone(&shared))),
            tokio::spawn(registrar::run(Arc::clone(&shared))),
        ];
        Ok(Node { shared, names, tasks: tasks.map(AbortOnDropHandle::new).into() })
    }

    /// The node's global name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.shared.name
    }

    /// The global name of `name` in this node, remapped.
    ///
    /// # Errors
    ///
    /// It is no name.
    pub fn resolve(&self, name: &str) -> Result<String, NameError> {
        self.names.resolve(name)
    }

    /// The master, to be asked other things.
    #[must_use]
    pub fn master(&self) -> &Master {
        &self.shared.master
    }

    /// Where the slave API is.
    #[must_use]
    pub fn api(&self) -> &Uri {
        &self.shared.api
    }

    /// How it stands with the master.
    #[must_use]
    pub fn state(&self) -> watch::Receiver<MasterState> {
        self.shared.state.subscribe()
    }

    /// Ready when somebody wanted this node to end (`rosnode kill`, or another node took its name): why. What the node has
    /// goes on until it is dropped.
    pub async fn ended(&self) -> String {
        let mut ended = self.shared.ended.subscribe();
        let why = ended.wait_for(Option::is_some).await.ok().and_then(|why| why.clone());
        match why {
            Some(why) => why,
            // The node is gone, and whoever waits with it.
            None => std::future::pending().await,
        }
    }

    /// Subscribes to a topic.
    ///
    /// # Errors
    ///
    /// It is no name, or subscribed already.
    pub fn subscribe<M: Message>(
        &self,
        topic: &str,
        options: SubscribeOptions,
    ) -> Result<Subscriber<M>, NodeError> {
        let mut topics = self.shared.topics();
        let subscription = self.add(&mut topics, topic, (M::TYPE, M::MD5), options)?;
        Ok(Subscriber::new(subscription, Arc::clone(&self.shared)))
    }

    /// Subscribes to a topic of any type: its messages as they come, each with its type.
    ///
    /// # Errors
    ///
    /// As [`Node::subscribe`].
    pub fn subscribe_any(
        &self,
        topic: &str,
        options: SubscribeOptions,
    ) -> Result<Subscriber<Incoming>, NodeError> {
        let mut topics = self.shared.topics();
        let subscription = self.add(&mut topics, topic, ("*", "*"), options)?;
        Ok(Subscriber::new(subscription, Arc::clone(&self.shared)))
    }

    /// Subscribes to a topic only to learn how often it is published: messages are counted as they pass, and not kept. A
    /// topic that is counted already is counted over one more window, by the same subscription.
    ///
    /// # Errors
    ///
    /// As [`Node::subscribe`].
    pub fn count(&self, topic: &str, window: Duration) -> Result<Arrivals, NodeError> {
        let mut topics = self.shared.topics();
        let counted = topics.subscriptions.get(&self.names.resolve(topic)?);
        let subscription = match counted.filter(|subscription| subscription.only_counts()) {
            Some(subscription) => Arc::clone(subscription),
            None => {
                self.begin(&mut topics, topic, ("*", "*"), SubscribeOptions::default(), true)?
            }
        };
        Ok(Arrivals::new(subscription, Arc::clone(&self.shared), window))
    }

    fn add(
        &self,
        topics: &mut Topics,
        topic: &str,
        kind: (&'static str, &'static str),
        options: SubscribeOptions,
    ) -> Result<Arc<Subscription>, NodeError> {
        self.begin(topics, topic, kind, options, false)
    }

    fn begin(
        &self,
        topics: &mut Topics,
        topic: &str,
        kind: (&'static str, &'static str),
        options: SubscribeOptions,
        counts: bool,
    ) -> Result<Arc<Subscription>, NodeError> {
        let topic = self.names.resolve(topic)?;
        if topics.subscriptions.contains_key(&topic) {
            return Err(NodeError::Twice { what: "subscribes", topic });
        }
        topics.leaving.remove(&Leaving::Subscription(topic.clone()));
        let subscription = Subscription::start(&self.shared, topic.clone(), kind, options, counts);
        topics.subscriptions.insert(topic, Arc::clone(&subscription));
        self.shared.work.notify_one();
        Ok(subscription)
    }

    /// Publishes a topic.
    ///
    /// # Errors
    ///
    /// It is no name, or published already.
    pub fn advertise<M: Message>(
        &self,
        topic: &str,
        options: PublishOptions,
    ) -> Result<Publisher<M>, NodeError> {
        let publication = self.publish(topic, describe::<M>().into(), options)?;
        Ok(Publisher::new(publication, Arc::clone(&self.shared)))
    }

    /// Publishes a topic of messages that are serialised already.
    ///
    /// # Errors
    ///
    /// As [`Node::advertise`].
    pub fn advertise_any(
        &self,
        topic: &str,
        of: Type,
        options: PublishOptions,
    ) -> Result<Publisher<Bytes>, NodeError> {
        let publication = self.publish(topic, of, options)?;
        Ok(Publisher::new(publication, Arc::clone(&self.shared)))
    }

    fn publish(
        &self,
        topic: &str,
        of: Type,
        options: PublishOptions,
    ) -> Result<Arc<Publication>, NodeError> {
        let topic = self.names.resolve(topic)?;
        let mut topics = self.shared.topics();
        if topics.publications.contains_key(&topic) {
            return Err(NodeError::Twice { what: "publishes", topic });
        }
        topics.leaving.remove(&Leaving::Publication(topic.clone()));
        let publication = Arc::new(Publication::new(topic.clone(), of, options));
        topics.publications.insert(topic, Arc::clone(&publication));
        drop(topics);
        self.shared.work.notify_one();
        Ok(publication)
    }

    /// Follows a parameter; `None` while it is not set, or not known yet.
    ///
    /// # Errors
    ///
    /// It is no name.
    pub fn follow_param(&self, key: &str) -> Result<watch::Receiver<Option<Value>>, NodeError> {
        let key = self.names.resolve(key)?;
        let mut topics = self.shared.topics();
        let new =
            || Arc::new(Param { value: watch::Sender::new(None), registered: Mutex::new(false) });
        let receiver = topics.params.entry(key).or_insert_with(new).value.subscribe();
        drop(topics);
        self.shared.work.notify_one();
        Ok(receiver)
    }

    /// Ends the node, and tells the master so.
    pub async fn shut_down(self) {
        let Topics { subscriptions, publications, params, mut leaving } =
            std::mem::take(&mut *self.shared.topics());
        leaving.extend(subscriptions.into_keys().map(Leaving::Subscription));
        leaving.extend(publications.into_keys().map(Leaving::Publication));
        leaving.extend(params.into_keys().map(Leaving::Param));
        // The registrar must not register again what is taken back here.
        let turn = tokio::time::timeout(FAREWELL, self.shared.turn.lock()).await;
        drop(self.tasks);
        drop(turn);
        let all = async {
            for one in leaving {
                if registrar::take_back(&self.shared, &one).await.is_err() {
                    return;
                }
            }
        };
        drop(tokio::time::timeout(FAREWELL, all).await);
    }
}

async fn own_address(master: &Uri) -> String {
    let resolved = tokio::net::lookup_host((&*master.host, master.port)).await;
    let address = resolved.ok().and_then(|mut found| found.next());
    address
        .map_or_else(|| "127.0.0.1".to_owned(), |address| env::address_towards(address).to_string())
}
