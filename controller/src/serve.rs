//! The one port: TLS, then HTTP/1.1 or HTTP/2, then one router for REST and gRPC.

use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use http::Request;
use hyper::body::Incoming;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use muster_api::wire::{HTTP2_FRAME, HTTP2_WINDOW};
use rustls::ServerConfig;
use tokio::net::{TcpListener, TcpStream};
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
}

impl Server {
    /// Takes connections until `stop`.
    pub(crate) async fn accept(self, listener: TcpListener) {
        loop {
            let accepted = tokio::select! {
                biased;
                () = self.stop.cancelled() => return,
                // Cancel safe: a connection that was not taken stays in the listener's queue.
                accepted = listener.accept() => accepted,
            };
            match accepted {
                Ok((stream, peer)) => {
                    let server = self.clone();
                    self.connections.spawn(async move {
                        if let Err(error) = server.connection(stream).await {
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
    ) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        let Self { tls, router, stop, kill, .. } = self;
        stream.set_nodelay(true)?;
        let handshake = TlsAcceptor::from(tls).accept(stream);
        let stream = tokio::select! {
            () = stop.cancelled() => return Ok(()),
            stream = tokio::time::timeout(HANDSHAKE, handshake) => stream??,
        };
        let certificates = stream.get_ref().1.peer_certificates();
        let identity = Identity::of(certificates.and_then(|chain| chain.first()));
        let service = hyper::service::service_fn(move |request: Request<Incoming>| {
            let mut request = request.map(Body::new);
            request.extensions_mut().insert(identity.clone());
            router.clone().oneshot(request)
        });
        let gauge = metrics::gauge!("muster_connections");
        gauge.increment(1);
        let builder = builder();
        let mut connection =
            pin!(builder.serve_connection_with_upgrades(TokioIo::new(stream), service));
        let ended = tokio::select! {
            ended = connection.as_mut() => ended,
            () = stop.cancelled() => {
                connection.as_mut().graceful_shutdown();
                tokio::select! {
                    ended = connection => ended,
                    () = kill.cancelled() => Ok(()),
                }
            }
        };
        gauge.decrement(1);
        ended
    }
}

fn builder() -> Builder<TokioExecutor> {
    let mut builder = Builder::new(TokioExecutor::new());
    builder.http1().timer(TokioTimer::new()).header_read_timeout(HEAD);
    builder
        .http2()
        .timer(TokioTimer::new())
        .keep_alive_interval(PING)
        .keep_alive_timeout(PING)
        .initial_stream_window_size(HTTP2_WINDOW)
        .initial_connection_window_size(HTTP2_WINDOW)
        .max_frame_size(HTTP2_FRAME)
        // One client may hold a watch per kind and a log per task.
        .max_concurrent_streams(1024);
    builder
}
