//! A connection to the controller: one for the session, and one for each stream that must not hold it up.

use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use hyper_util::rt::TokioIo;
use muster_api::wire::{HTTP2_FRAME, HTTP2_WINDOW};
use rustls::ClientConfig;
use tokio::sync::watch;
use tokio::time::Instant;
use tonic::transport::{Channel, Endpoint};

use super::{Address, tls};

/// The client's side of the services.
pub(crate) mod service {
    #![allow(
        clippy::all,
        clippy::allow_attributes,
        clippy::allow_attributes_without_reason,
        missing_debug_implementations,
        unreachable_pub,
        reason = "generated"
    )]
    include!(concat!(env!("OUT_DIR"), "/muster.agent.v1.rs"));
}

/// First and longest pause between two tries. The first is short, because a controller that is
/// started anew is back within seconds; the longest bounds how long a robot is alone for nothing.
pub const PAUSE: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(2));

/// A connection on which nothing was heard for this long is given up.
pub const DEAF_AFTER: Duration = Duration::from_secs(10);

/// Pauses between tries, each twice as long as the one before it.
#[derive(Debug)]
pub(super) struct Pauses(Duration);

impl Default for Pauses {
    fn default() -> Pauses {
        Pauses(PAUSE.0)
    }
}

impl Pauses {
    /// No try has failed since the last one that lasted.
    pub(super) fn is_first(&self) -> bool {
        self.0 == PAUSE.0
    }

    /// Waits after a try that began then; the first pause again after one that lasted.
    pub(super) async fn wait(&mut self, begun: Instant) {
        if begun.elapsed() > PAUSE.1 {
            self.0 = PAUSE.0;
        }
        tokio::time::sleep(self.spread()).await;
        self.0 = (self.0 * 2).min(PAUSE.1);
    }

    /// This pause, up to a half shorter: agents that lost the same controller come back one by one.
    fn spread(&self) -> Duration {
        let drawn = RandomState::new().build_hasher().finish();
        let shorter = (drawn >> 11) as f64 / (1_u64 << 53) as f64 / 2.0;
        self.0.mul_f64(1.0 - shorter)
    }
}

/// Why a stream beside the session ended.
#[derive(Debug, thiserror::Error)]
pub(super) enum StreamError {
    #[error(transparent)]
    Connect(#[from] DialError),
    #[error("the controller ended the stream")]
    Status(#[from] Box<tonic::Status>),
    #[error("the controller closed the stream")]
    Closed,
    #[error("the stream did not begin within {} s", DEAF_AFTER.as_secs())]
    Deaf,
}

/// There is no connection.
#[derive(Debug, thiserror::Error)]
#[error("failed to connect")]
pub(crate) struct DialError(#[source] tonic::transport::Error);

/// Makes connections to one controller, as this node.
#[derive(Debug, Clone)]
pub(crate) struct Dialer {
    pub(crate) address: Address,
    /// The newest: a connection has that of its beginning.
    pub(crate) tls: watch::Receiver<Arc<ClientConfig>>,
}

impl Dialer {
    /// Also the address by which the controller is reached.
    pub(crate) async fn channel(&self) -> Result<(Channel, Option<IpAddr>), DialError> {
        self.channel_with(DEAF_AFTER).await
    }

    /// One that is given up when nothing was heard on it for so long.
    pub(super) async fn channel_with(
        &self,
        deaf_after: Duration,
    ) -> Result<(Channel, Option<IpAddr>), DialError> {
        let endpoint = Endpoint::from_shared(format!("http://{}", self.address))
            .map_err(DialError)?
            .connect_timeout(DEAF_AFTER)
            .initial_stream_window_size(HTTP2_WINDOW)
            .initial_connection_window_size(HTTP2_WINDOW)
            .max_frame_size(HTTP2_FRAME)
            .http2_keep_alive_interval(deaf_after / 2)
            .keep_alive_timeout(deaf_after / 2)
            .keep_alive_while_idle(true);
        let (address, tls) = (self.address.clone(), Arc::clone(&self.tls.borrow()));
        let own = Arc::new(OnceLock::new());
        let found = Arc::clone(&own);
        let connector = tower::service_fn(move |_: http::Uri| {
            let (address, tls, found) = (address.clone(), Arc::clone(&tls), Arc::clone(&found));
            async move {
                let stream = tls::connect(&address, tls).await?;
                // Another one than that of the first connection would be no worse.
                let _ = found.set(stream.get_ref().0.get_ref().local_addr().ok());
                Ok::<_, tls::ConnectError>(TokioIo::new(stream))
            }
        });
        let channel = endpoint.connect_with_connector(connector).await.map_err(DialError)?;
        let own = own.get().copied().flatten();
        Ok((channel, own.map(|own: SocketAddr| own.ip())))
    }
}
