//! XML-RPC over HTTP: one call a connection as a client, calls one after the other as a server.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http::{Method, Request, Response, StatusCode, header};
use http_body_util::{BodyExt as _, Full, Limited};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use crate::pace::Pace;

use super::{Answer, Call, Fault, Malformed, Value, answer, call, write_answer, write_call};

/// What a master may answer: the state of a system with ten thousand topics takes two.
const LARGEST_ANSWER: usize = 16 << 20;
/// What anybody may ask: lists of publishers and parameters.
const LARGEST_CALL: usize = 1 << 20;
/// A master answers within milliseconds; one on a machine that swaps, within seconds.
const PATIENCE: Duration = Duration::from_secs(5);
/// Connections to a server that are served at once. Clients of ROS open one a call, or keep one each.
const AT_ONCE: usize = 64;
/// A connection on which nobody calls is closed after this: they are few.
const IDLE: Duration = Duration::from_secs(30);

/// Where a server is: the host and port of `http://HOST:PORT/`.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Uri {
    /// Name or address; of IPv6, without brackets.
    pub host: String,
    /// Port.
    pub port: u16,
}

/// A text is no address of a server.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is no address of a ROS master or node; write http://HOST:PORT, as in http://localhost:11311"
)]
pub struct UriError(String);

impl std::str::FromStr for Uri {
    type Err = UriError;

    fn from_str(text: &str) -> Result<Self, UriError> {
        let bad = || UriError(text.chars().take(200).collect());
        let parsed: http::Uri = text.trim().parse().map_err(|_| bad())?;
        if parsed.scheme_str() != Some("http") {
            return Err(bad());
        }
        let host = parsed.host().filter(|host| !host.is_empty()).ok_or_else(bad)?;
        let port = parsed.port_u16().filter(|port| *port != 0).ok_or_else(bad)?;
        Ok(Uri { host: host.trim_matches(['[', ']']).to_owned(), port })
    }
}

impl std::fmt::Display for Uri {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.host.contains(':') {
            true => write!(f, "http://[{}]:{}/", self.host, self.port),
            false => write!(f, "http://{}:{}/", self.host, self.port),
        }
    }
}

/// Why a call came to nothing.
#[derive(Debug, thiserror::Error)]
pub enum CallError {
    /// Nobody is there.
    #[error("failed to connect to {uri}")]
    Connect {
        /// Where.
        uri: Uri,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The connection broke, or spoke no HTTP.
    #[error("the connection to {uri} failed")]
    Http {
        /// Where.
        uri: Uri,
        /// Why.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// It answered with another status than 200.
    #[error("{uri} answered with HTTP status {status}")]
    Status {
        /// Where.
        uri: Uri,
        /// Which.
        status: StatusCode,
    },
    /// Nothing came in time.
    #[error("{uri} did not answer within {} s", PATIENCE.as_secs())]
    Timeout {
        /// Where.
        uri: Uri,
    },
    /// What came is no answer.
    #[error("{uri} answered with something else than XML-RPC")]
    Malformed {
        /// Where.
        uri: Uri,
        /// What is wrong with it.
        #[source]
        source: Malformed,
    },
    /// It does not do that.
    #[error("{uri} refused")]
    Fault {
        /// Where.
        uri: Uri,
        /// Why.
        #[source]
        source: Fault,
    },
}

/// Calls a method. Cancel safe: what is dropped is not waited for, though it may have been done.
///
/// # Errors
///
/// It came to nothing.
pub async fn invoke(uri: &Uri, method: &str, params: &[Value]) -> Result<Value, CallError> {
    let called = tokio::time::timeout(PATIENCE, exchange(uri, write_call(method, params)));
    called.await.map_err(|_| CallError::Timeout { uri: uri.clone() })?
}

async fn exchange(uri: &Uri, body: String) -> Result<Value, CallError> {
    let broken = |source| CallError::Http { uri: uri.clone(), source };
    let connected = TcpStream::connect((&*uri.host, uri.port)).await;
    let stream = connected.map_err(|source| CallError::Connect { uri: uri.clone(), source })?;
    // A call is one small packet: nothing to gather.
    drop(stream.set_nodelay(true));
    let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream))
        .await
        .map_err(|e| broken(e.into()))?;
    let request = Request::post("/")
        .header(header::HOST, format!("{}:{}", uri.host, uri.port))
        .header(header::CONTENT_TYPE, "text/xml")
        .header(header::CONNECTION, "close")
        .body(Full::new(Bytes::from(body)))
        .map_err(|e| broken(e.into()))?;
    let answered = async {
        let response = sender.send_request(request).await.map_err(|e| broken(e.into()))?;
        if response.status() != StatusCode::OK {
            return Err(CallError::Status { uri: uri.clone(), status: response.status() });
        }
        let body = Limited::new(response.into_body(), LARGEST_ANSWER).collect().await;
        let body = body.map_err(broken)?.to_bytes();
        let malformed = |source| CallError::Malformed { uri: uri.clone(), source };
        // rosmaster declares no encoding, which is UTF-8.
        let answer = answer(&String::from_utf8_lossy(&body)).map_err(malformed)?;
        answer.map_err(|source| CallError::Fault { uri: uri.clone(), source })
    };
    let connection = async {
        // Its end is the request's to tell.
        drop(connection.await);
        std::future::pending().await
    };
    tokio::select! {
        biased;
        answered = answered => answered,
        () = connection => unreachable!("it stays pending"),
    }
}

/// Answers calls.
pub trait Handler: Send + Sync + 'static {
    /// The answer to a call. It must be quick: it runs on the connection's task.
    fn handle(&self, call: Call) -> Answer;
}

/// Serves calls until dropped; a connection and a call are a turn each of the pace.
pub async fn serve(listener: TcpListener, handler: Arc<dyn Handler>, pace: Option<Pace>) {
    let room = Arc::new(Semaphore::new(AT_ONCE));
    let mut connections = JoinSet::new();
    loop {
        while connections.try_join_next().is_some() {}
        let permit = Arc::clone(&room).acquire_owned().await.expect("nobody closes it");
        let Ok((stream, _)) = listener.accept().await else {
            // Out of files, or a connection that went before it was taken: others may follow.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        if let Some(pace) = &pace {
            pace.turn().await;
        }
        drop(stream.set_nodelay(true));
        let (handler, pace) = (Arc::clone(&handler), pace.clone());
        connections.spawn(async move {
            let service = hyper::service::service_fn(|request| {
                respond(Arc::clone(&handler), pace.clone(), request)
            });
            let connection = hyper::server::conn::http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(IDLE)
                .serve_connection(TokioIo::new(stream), service);
            drop(connection.await);
            drop(permit);
        });
    }
}

async fn respond(
    handler: Arc<dyn Handler>,
    pace: Option<Pace>,
    request: Request<hyper::body::Incoming>,
) -> Result<Response<Full<Bytes>>, hyper::http::Error> {
    let refused = |status| Response::builder().status(status).body(Full::default());
    if let Some(pace) = pace {
        pace.turn().await;
    }
    if request.method() != Method::POST {
        return refused(StatusCode::METHOD_NOT_ALLOWED);
    }
    let body =
        tokio::time::timeout(PATIENCE, Limited::new(request.into_body(), LARGEST_CALL).collect());
    let body = match body.await {
        Ok(Ok(body)) => body.to_bytes(),
        Ok(Err(_)) => return refused(StatusCode::PAYLOAD_TOO_LARGE),
        Err(_) => return refused(StatusCode::REQUEST_TIMEOUT),
    };
    let answer = match call(&String::from_utf8_lossy(&body)) {
        Ok(call) => handler.handle(call),
        Err(malformed) => Err(Fault { code: -32700, text: malformed.to_string() }),
    };
    Response::builder()
        .header(header::CONTENT_TYPE, "text/xml")
        .body(Full::new(Bytes::from(write_answer(&answer))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_uri_has_a_host_and_a_port() {
        let uri: Uri = "http://robot-1:11311/".parse().unwrap();
        assert_eq!((uri.host.as_str(), uri.port), ("robot-1", 11311));
        assert_eq!(uri.to_string().parse(), Ok(uri));
        let six: Uri = "http://[::1]:80".parse().unwrap();
        assert_eq!((six.host.as_str(), six.to_string().as_str()), ("::1", "http://[::1]:80/"));
        for bad in
            ["", "robot:11311", "http://robot", "https://robot:1/", "http://:5/", "http://a:0/"]
        {
            assert!(bad.parse::<Uri>().is_err(), "{bad}");
        }
    }

    struct Echo;

    impl Handler for Echo {
        fn handle(&self, call: Call) -> Answer {
            match &*call.method {
                "echo" => Ok(Value::Array(call.params)),
                other => Err(Fault { code: 1, text: format!("no {other}") }),
            }
        }
    }

    async fn echo() -> (Uri, tokio_util::task::AbortOnDropHandle<()>) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let serve = serve(listener, Arc::new(Echo), None);
        let server = tokio_util::task::AbortOnDropHandle::new(tokio::spawn(serve));
        (Uri { host: "127.0.0.1".to_owned(), port }, server)
    }

    #[tokio::test]
    async fn calls_are_answered_over_http() {
        let (uri, _server) = echo().await;
        let params = [Value::Int(4), "ä & <b>".into()];
        assert_eq!(invoke(&uri, "echo", &params).await.unwrap(), Value::Array(params.to_vec()));
        let refused = invoke(&uri, "other", &[]).await.unwrap_err();
        assert!(matches!(refused, CallError::Fault { source, .. } if source.text == "no other"));
        let large = Value::String("x".repeat(LARGEST_CALL));
        let refused = invoke(&uri, "echo", &[large]).await.unwrap_err();
        // The server may close before it has read all that the client still writes.
        assert!(
            matches!(refused, CallError::Status { .. } | CallError::Http { .. }),
            "{refused:?}"
        );
    }

    #[tokio::test]
    async fn nobody_there_is_told_at_once() {
        let port = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap().port();
        let uri = Uri { host: "127.0.0.1".to_owned(), port };
        assert!(matches!(invoke(&uri, "echo", &[]).await, Err(CallError::Connect { .. })));
    }
}
