//! The one port: TLS, then HTTP/1.1 or HTTP/2, then one router for REST and gRPC.

use std::net::SocketAddr;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
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
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
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
    pub(crate) tls: Arc<ServerConfig>,
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
}

impl Default for Limits {
    fn default() -> Self {
        let handshakes = Arc::new(Semaphore::new(HANDSHAKES));
        Self { handshakes, strangers: Arc::new(Semaphore::new(STRANGERS)) }
    }
}

/// The other end of a connection, in the extensions of its requests.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Peer(pub(crate) SocketAddr);

/// The place among strangers of a connection without a certificate, in the extensions of its requests.
#[derive(Debug, Clone)]
pub(crate) struct Stranger(Arc<Mutex<Option<OwnedSemaphorePermit>>>);

impl Stranger {
    /// A request said who they are, by a token: who floods us with connections of strangers keeps no users out.
    pub(crate) fn is_known(&self) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take();
    }
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
        let handshake = TlsAcceptor::from(tls).accept(stream);
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
                Some(Stranger(Arc::new(Mutex::new(Some(place)))))
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
