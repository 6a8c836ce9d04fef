//! A master that is served: the registry's answers over XML-RPC, and what others are told of them.
//!
//! ```text
//!   node ── call ──▶ Registry ── answer ──▶ node
//!                       └── notices ──▶ one queue an address ── publisherUpdate, paramUpdate, shutdown ──▶ node
//! ```
//!
//! A node that does not answer is told once and not waited for: it asks when it is back, as with rosmaster.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::net::TcpListener;
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tokio_util::task::AbortOnDropHandle;

use crate::pace::Pace;
use crate::registry::{Notice, Registry, Response};
use crate::xmlrpc::http::{Handler, Uri, invoke, serve};
use crate::xmlrpc::{self, Answer, Call, Fault, Value, write_call};

/// Nodes that are told something at once. Each has seconds to answer.
const AT_ONCE: usize = 64;

/// Keeps what a master knows, before those who told it are answered. What is not kept is not answered as done.
pub type Save = Box<dyn Fn(&str) -> io::Result<()> + Send + Sync>;

/// What is different with one that others begin.
#[derive(Default)]
struct Kept {
    save: Option<Save>,
    pace: Option<Pace>,
}

/// A running master. When it is dropped, nobody answers any more.
#[derive(Debug)]
pub struct Roscore {
    state: Arc<State>,
    uri: Uri,
    _tasks: [AbortOnDropHandle<()>; 2],
}

struct State {
    registry: Mutex<Registry>,
    save: Option<Save>,
    outgoing: Mutex<BTreeMap<String, VecDeque<Notice>>>,
    some: Notify,
}

impl std::fmt::Debug for State {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("State").field("registry", &self.registry).finish_non_exhaustive()
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Nobody panics within: what is behind is whole.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Roscore {
    /// Serves a master at `listener`, which nodes reach under the name or address `host`.
    ///
    /// # Errors
    ///
    /// The listener has no address.
    pub fn start(listener: TcpListener, host: &str) -> io::Result<Roscore> {
        Roscore::begin(listener, host, |_| {}, Kept::default())
    }

    /// Goes on with what an earlier one knew, as that was last saved; what cannot be read is nothing. It is called at this pace.
    ///
    /// # Errors
    ///
    /// As [`Roscore::start`].
    pub fn resume(
        listener: TcpListener,
        host: &str,
        known: &str,
        save: Save,
        pace: Pace,
    ) -> io::Result<Roscore> {
        let learn = |registry: &mut Registry| match xmlrpc::call(known) {
            // Whoever is named in it was told of it by the earlier one.
            Ok(recital) => drop(registry.handle(&recital)),
            Err(error) if known.is_empty() => tracing::debug!(%error, "a new master"),
            Err(error) => tracing::warn!(%error, "what a ROS master knew cannot be read"),
        };
        Roscore::begin(listener, host, learn, Kept { save: Some(save), pace: Some(pace) })
    }

    fn begin(
        listener: TcpListener,
        host: &str,
        learn: impl FnOnce(&mut Registry),
        Kept { save, pace }: Kept,
    ) -> io::Result<Roscore> {
        let uri = Uri { host: host.to_owned(), port: listener.local_addr()?.port() };
        let pid = i32::try_from(std::process::id()).unwrap_or(i32::MAX);
        let mut registry = Registry::new(&uri.to_string(), pid);
        learn(&mut registry);
        let state = Arc::new(State {
            registry: Mutex::new(registry),
            save,
            outgoing: Mutex::default(),
            some: Notify::new(),
        });
        let handler: Arc<dyn Handler> = Arc::clone(&state) as _;
        let tasks =
            [tokio::spawn(serve(listener, handler, pace)), tokio::spawn(tell(Arc::clone(&state)))];
        Ok(Roscore { state, uri, _tasks: tasks.map(AbortOnDropHandle::new) })
    }

    /// Where it is.
    #[must_use]
    pub fn uri(&self) -> &Uri {
        &self.uri
    }

    /// The node `name` at `api` is the owner's; see [`Registry::keep`].
    pub fn keep(&self, name: &str, api: &Uri) {
        lock(&self.state.registry).keep(name, &api.to_string());
    }
}

impl Handler for State {
    fn handle(&self, call: Call) -> Answer {
        // Held together: notices are queued in the order in which what they tell came about.
        let mut registry = lock(&self.registry);
        let Response { mut answer, notices } = registry.handle(&call);
        if let Some(save) = self.save.as_ref().filter(|_| changes(&call.method)) {
            let Call { method, params } = registry.recital();
            if let Err(error) = save(&write_call(&method, &params)) {
                tracing::warn!(%error, "what a ROS master knows cannot be kept");
                answer =
                    Err(Fault { code: 1, text: format!("the master cannot keep it: {error}") });
            }
        }
        if !notices.is_empty() {
            let mut outgoing = lock(&self.outgoing);
            notices.into_iter().for_each(|notice| queue(&mut outgoing, notice));
            self.some.notify_one();
        }
        answer
    }
}

/// Whether a call may change what the master knows.
fn changes(method: &str) -> bool {
    let asks = ["get", "has", "search", "lookup"].iter().any(|word| method.starts_with(word));
    !asks && method != "shutdown"
}

/// One that waits and is about the same is out of date.
fn queue(outgoing: &mut BTreeMap<String, VecDeque<Notice>>, notice: Notice) {
    let waiting = outgoing.entry(to(&notice).to_owned()).or_default();
    waiting.retain(|older| match (older, &notice) {
        (Notice::Publishers { topic: a, .. }, Notice::Publishers { topic: b, .. }) => a != b,
        (Notice::Param { key: a, .. }, Notice::Param { key: b, .. }) => a != b,
        (Notice::Shutdown { .. }, Notice::Shutdown { .. }) => false,
        _ => true,
    });
    waiting.push_back(notice);
}

fn to(notice: &Notice) -> &str {
    match notice {
        Notice::Publishers { to, .. } | Notice::Param { to, .. } | Notice::Shutdown { to, .. } => {
            to
        }
    }
}

/// Tells everybody what waits for him, one after the other.
async fn tell(state: Arc<State>) {
    let mut telling: BTreeSet<String> = BTreeSet::new();
    let mut calls: JoinSet<String> = JoinSet::new();
    loop {
        while calls.len() < AT_ONCE {
            let Some((address, notice)) = next(&mut lock(&state.outgoing), &telling) else { break };
            telling.insert(address.clone());
            calls.spawn(async move {
                say(notice).await;
                address
            });
        }
        // Cancel-safe: a notification and a join.
        tokio::select! {
            () = state.some.notified() => {}
            Some(said) = calls.join_next() => {
                if let Ok(address) = said {
                    telling.remove(&address);
                }
            }
        }
    }
}

fn next(
    outgoing: &mut BTreeMap<String, VecDeque<Notice>>,
    telling: &BTreeSet<String>,
) -> Option<(String, Notice)> {
    outgoing.retain(|_, waiting| !waiting.is_empty());
    let (address, waiting) = outgoing.iter_mut().find(|(to, _)| !telling.contains(*to))?;
    Some((address.clone(), waiting.pop_front()?))
}

async fn say(notice: Notice) {
    let master = Value::from("/master");
    let (to, method, params) = match notice {
        Notice::Publishers { to, topic, publishers } => {
            let publishers = publishers.into_iter().map(Value::from).collect::<Vec<_>>().into();
            (to, "publisherUpdate", vec![master, topic.into(), publishers])
        }
        Notice::Param { to, key, value } => (to, "paramUpdate", vec![master, key.into(), value]),
        Notice::Shutdown { to, why } => (to, "shutdown", vec![master, why.into()]),
    };
    let Ok(uri) = to.parse::<Uri>() else { return };
    if let Err(error) = invoke(&uri, method, &params).await {
        tracing::debug!(to, method, %error, "a node was not told");
    }
}
