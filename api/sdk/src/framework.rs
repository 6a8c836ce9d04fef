//! Who a framework is, what it wants, and how it begins.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use muster_api::wire::framework::v1 as proto;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

use crate::link::direct::Lanes;
use crate::link::kubeconfig;
use crate::link::session::{Identity, Inbox, Link, Session};
use crate::link::state::StateFile;
use crate::{ConnectError, EventStream, Filter, FrameworkHandle, Position, event};

/// Calls that wait for the session.
const CALLS: usize = 64;

/// An outside scheduler; see [`Framework::builder`].
#[derive(Debug)]
pub struct Framework;

impl Framework {
    /// Begins to describe the framework of this name, an RFC 1123 label.
    ///
    /// ```no_run
    /// # async fn example() -> Result<(), muster_sdk::ConnectError> {
    /// use muster_sdk::{Filter, Framework};
    /// let (handle, mut events) = Framework::builder("deliver")
    ///     .position(3.0, 4.0)
    ///     .radius(20.0)
    ///     .filter(Filter::robots().free_actuators())
    ///     .connect(None)
    ///     .await?;
    /// while let Some(event) = events.next().await {
    ///     println!("{event:?}");
    /// }
    /// # Ok(()) }
    /// ```
    pub fn builder(name: impl Into<String>) -> Builder {
        Builder {
            name: name.into(),
            namespace: None,
            position: None,
            radius: None,
            filter: None,
            failover: None,
            state_file: None,
        }
    }
}

/// What [`Framework::builder`] gives.
#[derive(Debug, Clone)]
#[must_use = "a framework begins with connect()"]
pub struct Builder {
    name: String,
    namespace: Option<String>,
    position: Option<Position>,
    radius: Option<f64>,
    filter: Option<Filter>,
    failover: Option<Duration>,
    state_file: Option<PathBuf>,
}

impl Builder {
    /// The namespace of the framework and its tasks; without one, the kubeconfig's.
    pub fn namespace(mut self, namespace: impl Into<String>) -> Self {
        self.namespace = Some(namespace.into());
        self
    }

    /// Where the work is: metres in the default map's frame.
    pub fn position(self, x: f64, y: f64) -> Self {
        self.at(Position::at(x, y))
    }

    /// Where the work is, in full.
    pub fn at(mut self, position: Position) -> Self {
        self.position = Some(position);
        self
    }

    /// How far from the position a robot may be, metres.
    pub fn radius(mut self, metres: f64) -> Self {
        self.radius = Some(metres);
        self
    }

    /// What a node must have to be offered.
    pub fn filter(mut self, filter: Filter) -> Self {
        self.filter = Some(filter);
        self
    }

    /// How long the framework may be away until its tasks are killed; without one, a minute.
    pub fn failover_timeout(mut self, timeout: Duration) -> Self {
        self.failover = Some(timeout);
        self
    }

    /// Where the framework's id is kept, so that the next run of this program takes its tasks over.
    pub fn state_file(mut self, path: impl Into<PathBuf>) -> Self {
        self.state_file = Some(path.into());
        self
    }

    /// Begins. The controller is the one of `kubeconfig`, or of `MUSTER_CONFIG`, `KUBECONFIG` or `~/.muster/config`,
    /// whichever is found first. Returns as soon as that much is known: that the framework is registered, or refused, is
    /// an event, and a controller that cannot be reached is tried again until the stream is dropped.
    ///
    /// # Errors
    ///
    /// When the kubeconfig, the credentials in it or the state file cannot be used.
    pub async fn connect(
        self,
        kubeconfig: Option<&Path>,
    ) -> Result<(FrameworkHandle, EventStream), ConnectError> {
        let target = kubeconfig::load(&kubeconfig::files(kubeconfig))?;
        let tls = target.tls().map_err(ConnectError::Credentials)?;
        let direct = target.direct_tls().map_err(ConnectError::Credentials)?;
        let position = match (self.position, self.radius) {
            (Some(position), Some(radius)) => Some(position.radius(radius)),
            (None, Some(_)) => return Err(ConnectError::RadiusWithoutPosition),
            (position, None) => position,
        };
        let state = StateFile::new(self.state_file);
        let subscribe = proto::Subscribe {
            name: self.name,
            namespace: self.namespace.or_else(|| target.namespace.clone()).unwrap_or_default(),
            framework_id: state.read().await?.unwrap_or_default(),
            position: position.map(|position| position.0),
            filter: self.filter.map(|filter| filter.0),
            failover_timeout_seconds: self.failover.map(|timeout| timeout.as_secs_f64()),
            direct: target.has_certificate(),
            nonce: uuid::Uuid::new_v4().to_string(),
        };
        let (to_session, commands) = mpsc::channel(CALLS);
        let (to_stream, inlet) = event::channel();
        let stop = CancellationToken::new();
        let link = Link {
            address: target.address,
            tls: Arc::new(tls),
            authorization: target.authorization,
        };
        let (lanes, relayed) = Lanes::new(Arc::new(direct), to_stream.clone());
        let inbox = Inbox { commands, relayed, lanes: lanes.clone() };
        let identity = Identity { subscribe, state };
        let session = Session::new(link, identity, inbox, to_stream, stop.clone());
        let session = AbortOnDropHandle::new(tokio::spawn(session.run()));
        let handle = FrameworkHandle::new(to_session, lanes, stop);
        Ok((handle, EventStream { inlet, _session: session }))
    }
}
