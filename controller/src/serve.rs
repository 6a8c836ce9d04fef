//! The one port: TLS, then HTTP/1.1 or HTTP/2, then one router for REST and gRPC.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use http::Request;
use hyper::body::Incoming;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use muster_api::wire::{HTTP2_FRAME, HTTP2_WINDOW};
use rustix::net::sockopt;
use rustls::ServerConfig;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tower::ServiceExt as _;

use crate::auth::Identity;

/// A client that has not finished its handshake by then is gone or hostile.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// For a request's head; an idle connection waits for the next one as well. As long as Kubernetes' API server keeps idle
/// connections: clients keep them so long, and lose the request that they send just as the server closes.
const HEAD: Duration = Duration::from_secs(90);
/// An HTTP/2 peer that vanished (robot out of the building) is noticed by a ping after this silence.
const PING: Duration = Duration::from_secs(15);
/// A peer that takes nothing of what is sent to it for so long is gone, whatever it speaks.
const GONE: Duration = Duration::from_secs(120);
/// When accept fails, file descriptors are used up; closing connections frees them, spinning does not.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// What a connection needs.
#[derive(Clone)]
pub(crate) struct Server {
    /// The newest: a connection has that of its beginning.
    pub(crate) tls: watch::Receiver<Arc<ServerConfig>>,
    pub(crate) router: Router,
    /// Finish what is being answered, take nothing new.
    pub(crate) stop: CancellationToken,
    /// End at once.
    pub(crate) kill: CancellationToken,
    pub(crate) connections: TaskTracker,
    pub(crate) limits: Arc<Limits>,
}

/// Handshakes at once. Each costs a millisecond or two; who comes when all are under way waits in the listener's queue.
const HANDSHAKES: usize = 512;
/// Connections without a certificate at once: agents that join, and who asks whether the controller lives. One more is closed.
const STRANGERS: usize = 256;
/// Connections that one user's tokens let in beside strangers, also those of tokens that have ended since. A fleet of one
/// user's programs has a connection each.
const CONNECTIONS_OF_A_USER: usize = 512;
/// Requests at once on a connection. One client may hold a watch per kind and a log per task.
const REQUESTS: u32 = 1024;
/// The same of one without a certificate.
const REQUESTS_OF_STRANGERS: u32 = 8;
/// Bytes under way to us on a connection without a certificate, and for each of its requests.
const WINDOW_OF_STRANGERS: u32 = 64 << 10;

/// How many connections there may be of those that anybody can open.
#[derive(Debug)]
pub(crate) struct Limits {
    handshakes: Arc<Semaphore>,
    strangers: Arc<Semaphore>,
    users: Arc<Users>,
}

impl Default for Limits {
    fn default() -> Self {
        let handshakes = Arc::new(Semaphore::new(HANDSHAKES));
        let strangers = Arc::new(Semaphore::new(STRANGERS));
        Self { handshakes, strangers, users: Arc::default() }
    }
}

/// The other end of a connection, in the extensions of its requests.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Peer(pub(crate) SocketAddr);

/// The place of a connection without a certificate, in the extensions of its requests: among strangers, until a request says
/// by a token who they are.
#[derive(Debug, Clone)]
pub(crate) struct Stranger {
    place: Arc<Mutex<Place>>,
    users: Arc<Users>,
}

#[derive(Debug)]
enum Place {
    /// Held for as long as it is there.
    Stranger { _permit: OwnedSemaphorePermit },
    /// The same.
    User { _seat: Seat },
}

impl Stranger {
    fn new(permit: OwnedSemaphorePermit, users: &Arc<Users>) -> Self {
        let place = Arc::new(Mutex::new(Place::Stranger { _permit: permit }));
        Self { place, users: Arc::clone(users) }
    }

    /// A request said who they are: who floods us with connections of strangers keeps no users out. A user with too many
    /// connections stays among strangers: what a token let in once, it does not hold open without bound.
    pub(crate) fn is_known_as(&self, user: &str) {
        let mut place = lock(&self.place);
        if matches!(*place, Place::Stranger { .. })
            && let Some(seat) = Users::sit(&self.users, user)
        {
            *place = Place::User { _seat: seat };
        }
    }
}

/// Connections of users by their names.
#[derive(Debug, Default)]
struct Users(Mutex<HashMap<String, usize>>);

/// One of a user's connections.
#[derive(Debug)]
struct Seat {
    users: Arc<Users>,
    user: String,
}

impl Users {
    /// None: the user has as many as there may be.
    fn sit(all: &Arc<Self>, user: &str) -> Option<Seat> {
        let mut seats = lock(&all.0);
        let taken = seats.entry(user.to_owned()).or_default();
        if *taken >= CONNECTIONS_OF_A_USER {
            return None;
        }
        *taken += 1;
        Some(Seat { users: Arc::clone(all), user: user.to_owned() })
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let mut seats = lock(&self.users.0);
        if let Some(taken) = seats.get_mut(&self.user) {
            *taken -= 1;
            if *taken == 0 {
                seats.remove(&self.user);
            }
        }
    }
}

/// The lock of what nothing panics in half way through a change.
fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A connection that is counted, however it ends.
struct Counted(metrics::Gauge);

impl Counted {
    fn begin() -> Self {
        let gauge = metrics::gauge!("muster_connections");
        gauge.increment(1);
        Self(gauge)
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.decrement(1);
    }
}

impl Server {
    /// Takes connections until `stop`.
    pub(crate) async fn accept(self, listener: TcpListener) {
        loop {
            let next = async {
                let handshake = Arc::clone(&self.limits.handshakes).acquire_owned().await;
                (handshake.ok(), listener.accept().await)
            };
            let (handshake, accepted) = tokio::select! {
                biased;
                () = self.stop.cancelled() => return,
                // Cancel safe: a connection that was not taken stays in the listener's queue.
                next = next => next,
            };
            match accepted {
                Ok((stream, peer)) => {
                    let server = self.clone();
                    self.connections.spawn(async move {
                        if let Err(error) = server.connection(stream, handshake).await {
                            tracing::debug!(%peer, error, "connection ended");
                        }
                    });
                }
                Err(error) => {
                    tracing::warn!(error = &error as &dyn std::error::Error, "cannot accept");
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    async fn connection(
        self,
        stream: TcpStream,
        shaking: Option<OwnedSemaphorePermit>,
    ) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        let Self { tls, router, stop, kill, limits, .. } = self;
        watch_over(&stream)?;
        let peer = Peer(stream.peer_addr()?);
        let newest = Arc::clone(&tls.borrow());
        let handshake = TlsAcceptor::from(newest).accept(stream);
        let stream = tokio::select! {
            () = stop.cancelled() => return Ok(()),
            stream = tokio::time::timeout(HANDSHAKE, handshake) => stream??,
        };
        let certificates = stream.get_ref().1.peer_certificates();
        let identity = Identity::of(certificates.and_then(|chain| chain.first()));
        drop(shaking);
        let known = identity != Identity::Anonymous;
        let stranger = match known {
            true => None,
            false => {
                let place = Arc::clone(&limits.strangers).try_acquire_owned()?;
                Some(Stranger::new(place, &limits.users))
            }
        };
        let service = hyper::service::service_fn(move |request: Request<Incoming>| {
            let mut request = request.map(Body::new);
            let extensions = request.extensions_mut();
            extensions.insert(identity.clone());
            extensions.insert(peer);
            if let Some(stranger) = &stranger {
                extensions.insert(stranger.clone());
            }
            router.clone().oneshot(request)
        });
        let _counted = Counted::begin();
        let builder = builder(known);
        let mut connection =
            pin!(builder.serve_connection_with_upgrades(TokioIo::new(stream), service));
        tokio::select! {
            ended = connection.as_mut() => ended,
            () = stop.cancelled() => {
                connection.as_mut().graceful_shutdown();
                tokio::select! {
                    ended = connection => ended,
                    () = kill.cancelled() => Ok(()),
                }
            }
        }
    }
}

/// Small messages are not kept back, and a peer that is gone without a word is noticed: HTTP/1.1 has no pings of its own.
fn watch_over(stream: &TcpStream) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    sockopt::set_socket_keepalive(stream, true)?;
    sockopt::set_tcp_keepidle(stream, PING)?;
    sockopt::set_tcp_keepintvl(stream, PING / 3)?;
    sockopt::set_tcp_keepcnt(stream, 3)?;
    let gone_after = u32::try_from(GONE.as_millis()).unwrap_or(u32::MAX);
    Ok(sockopt::set_tcp_user_timeout(stream, gone_after)?)
}

/// How a connection is served; `known`: its client has shown a certificate.
fn builder(known: bool) -> Builder<TokioExecutor> {
    let (window, requests) = match known {
        true => (HTTP2_WINDOW, REQUESTS),
        false => (WINDOW_OF_STRANGERS, REQUESTS_OF_STRANGERS),
    };
    let mut builder = Builder::new(TokioExecutor::new());
    builder.http1().timer(TokioTimer::new()).header_read_timeout(HEAD);
    if !known {
        builder.http1().max_buf_size(WINDOW_OF_STRANGERS as usize);
    }
    builder
        .http2()
        .timer(TokioTimer::new())
        .keep_alive_interval(PING)
        .keep_alive_timeout(PING)
        .initial_stream_window_size(window)
        .initial_connection_window_size(window)
        .max_frame_size(HTTP2_FRAME)
        .max_concurrent_streams(requests);
    builder
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_user_with_too_many_connections_is_a_stranger_with_the_next() {
        let limits = Limits::default();
        let connect = || {
            let permit = Arc::clone(&limits.strangers).try_acquire_owned().unwrap();
            let stranger = Stranger::new(permit, &limits.users);
            stranger.is_known_as("ada");
            stranger
        };
        let mut all: Vec<Stranger> = (0..CONNECTIONS_OF_A_USER).map(|_| connect()).collect();
        assert_eq!(limits.strangers.available_permits(), STRANGERS);
        all.push(connect());
        assert_eq!(limits.strangers.available_permits(), STRANGERS - 1);
        // Another request of a connection that has its place changes nothing.
        all[0].is_known_as("ada");
        all.swap_remove(0);
        all.push(connect());
        assert_eq!(limits.strangers.available_permits(), STRANGERS - 1);
        drop(all);
        assert_eq!(limits.strangers.available_permits(), STRANGERS);
        assert!(lock(&limits.users.0).is_empty());
    }
}
