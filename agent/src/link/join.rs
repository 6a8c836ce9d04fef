//! From a token, or from the certificate that is there, to a new one. The key is made here and never leaves.
//!
//! ```text
//!   DIR/pki/asked.key                           what a join asks with, until it is over: who asks again is known by it
//!   DIR/pki/node.key ca.crt token-id node.crt   what a join gave, written in this order
//!   DIR/pki/renewed.json                        those of the last renewal, in one file: it is there whole or not
//! ```

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::TryFutureExt;
use http::{Request, StatusCode, header};
use hyper::body::Body;
use hyper_util::rt::TokioIo;
use muster_failpoint::{Failpoint, Step, reach};
use rcgen::{CertificateParams, DnType, KeyPair};
use rustls::{ClientConfig, ServerConfig};
use serde::{Deserialize, Serialize};

use super::Address;
use super::tls::{self, ConnectError};
use super::token::Token;
use crate::config::Kind;
use crate::durable::{self, FileError, Keep};

/// An answer to a join is a signature and a row in a table.
const PATIENCE: Duration = Duration::from_secs(20);

/// An answer holds two certificates, or a status.
const LONGEST_ANSWER: usize = 256 << 10;

/// The file of the key that a join asks with.
const ASKED: &str = "asked.key";

/// The file of the last renewal.
const RENEWED: &str = "renewed.json";

/// Why this agent has not joined.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// See the source.
    #[error("failed to join")]
    Connect(#[from] ConnectError),
    /// The controller does not answer as one.
    #[error("the controller did not answer the request to join")]
    Http(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The controller says no.
    #[error("the controller refuses to let {node} join ({status}): {message}")]
    Refused {
        /// Who asked.
        node: String,
        /// The HTTP status.
        status: u16,
        /// The controller's words.
        message: String,
    },
    /// The controller's certificate is not from the CA that the token names.
    #[error(
        "the server at {0} is not the controller that made this token: its CA has another hash"
    )]
    WrongCa(String),
    /// No key could be made.
    #[error("failed to make a key")]
    Key(#[source] rcgen::Error),
    /// Credentials could not be stored.
    #[error("failed to store the credentials")]
    Store(#[from] FileError),
}

/// The files of a joined agent.
#[derive(Debug, Clone)]
pub(crate) struct Credentials {
    dir: PathBuf,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct JoinRequest<'a> {
    /// Absent: the connection's certificate speaks for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    token: Option<&'a str>,
    node_name: &'a str,
    kind: &'static str,
    csr: String,
}

#[derive(Deserialize)]
struct JoinAnswer {
    certificate: String,
    ca: String,
}

/// What a renewal gave, as it is kept: PEM.
#[derive(Serialize, Deserialize)]
struct Renewed {
    ca: String,
    certificate: String,
    key: String,
}

#[derive(Deserialize)]
struct StatusAnswer {
    #[serde(default)]
    message: String,
}

impl Credentials {
    pub(crate) fn at(data_dir: &Path) -> Credentials {
        Credentials { dir: data_dir.join("pki") }
    }

    /// Whether this agent joined before.
    pub(crate) fn exist(&self) -> bool {
        // The certificate is written last.
        self.dir.join("node.crt").exists()
    }

    /// Whether they came by this token. Another one is a wish to join anew: the node was deleted, or
    /// registered again.
    pub(crate) fn came_by(&self, token: &Token) -> bool {
        std::fs::read_to_string(self.dir.join("token-id")).is_ok_and(|id| id == token.id())
    }

    /// The session's TLS.
    pub(crate) fn tls(&self) -> Result<ClientConfig, JoinError> {
        let [ca, certificate, key] = self.read()?;
        Ok(tls::mutual(&ca, &certificate, &key)?)
    }

    /// TLS for frameworks that come directly; none: the certificate is older than that.
    pub(crate) fn serving(&self, node: &str) -> Result<Option<ServerConfig>, JoinError> {
        let [ca, certificate, key] = self.read()?;
        Ok(tls::serving(&ca, &certificate, &key, node)?)
    }

    /// The certificate, PEM.
    pub(crate) fn certificate(&self) -> Result<Vec<u8>, FileError> {
        let [_, certificate, _] = self.read()?;
        Ok(certificate)
    }

    /// CA, certificate and key.
    fn read(&self) -> Result<[Vec<u8>; 3], FileError> {
        let read = |name: &str| {
            let path = self.dir.join(name);
            std::fs::read(&path).map_err(FileError::at("read", &path))
        };
        match durable::read_json::<Renewed>(&self.dir.join(RENEWED))? {
            Some(Renewed { ca, certificate, key }) => Ok([ca, certificate, key].map(Into::into)),
            None => Ok([read("ca.crt")?, read("node.crt")?, read("node.key")?]),
        }
    }

    /// The key that a join asks with: that of an earlier try, which may have been granted without this agent hearing so.
    fn asked(&self) -> Result<KeyPair, JoinError> {
        let path = self.dir.join(ASKED);
        if let Some(key) =
            std::fs::read_to_string(&path).ok().and_then(|pem| KeyPair::from_pem(&pem).ok())
        {
            return Ok(key);
        }
        std::fs::create_dir_all(&self.dir).map_err(FileError::at("make", &self.dir))?;
        let key = KeyPair::generate().map_err(JoinError::Key)?;
        let pem = key.serialize_pem();
        durable::write(Failpoint::AskedKey, &path, pem.as_bytes(), 0o600, Keep::PowerCut)?;
        Ok(key)
    }

    /// It has joined: nothing is asked any more.
    pub(crate) fn settle(&self) -> Result<(), FileError> {
        durable::remove_file(&self.dir.join(ASKED))
    }

    fn renew(&self, key: String, answer: JoinAnswer) -> Result<(), FileError> {
        let JoinAnswer { certificate, ca } = answer;
        let renewed = Renewed { ca, certificate, key };
        durable::write_json(Failpoint::Renewal, &self.dir.join(RENEWED), &renewed, Keep::PowerCut)
    }

    fn write(&self, key: &str, answer: &JoinAnswer, token: &Token) -> Result<(), FileError> {
        // Those of an earlier join end first: a key never stands beside another's certificate.
        for (former, step) in [("node.crt", Step::Before), (RENEWED, Step::Half)] {
            reach(Failpoint::FormerJoin, step);
            durable::remove_file(&self.dir.join(former))?;
        }
        reach(Failpoint::FormerJoin, Step::After);
        for (point, name, text) in [
            (Failpoint::JoinKey, "node.key", key),
            (Failpoint::JoinCa, "ca.crt", &answer.ca),
            (Failpoint::JoinToken, "token-id", token.id()),
            (Failpoint::JoinCertificate, "node.crt", &answer.certificate),
        ] {
            durable::write(point, &self.dir.join(name), text.as_bytes(), 0o600, Keep::PowerCut)?;
        }
        Ok(())
    }
}

/// Joins as `node` and stores what the controller gives.
pub(crate) async fn join(
    address: &Address,
    token: &Token,
    node: &str,
    kind: Kind,
    credentials: &Credentials,
) -> Result<(), JoinError> {
    let config = tls::by_hash(token.ca_hash)?;
    let key = credentials.asked()?;
    let answer = ask((address, config), Some(token), (node, kind), &key).await?;
    credentials.write(&key.serialize_pem(), &answer, token)?;
    Ok(())
}

/// Asks for another certificate by the one that is there, and stores it.
pub(crate) async fn renew(
    address: &Address,
    (node, kind): (&str, Kind),
    credentials: &Credentials,
) -> Result<(), JoinError> {
    let mut config = credentials.tls()?;
    // One request, and no streams.
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    let key = KeyPair::generate().map_err(JoinError::Key)?;
    let answer = ask((address, config), None, (node, kind), &key).await?;
    let key = key.serialize_pem();
    // Whatever was answered: what is stored lets this node in.
    tls::mutual(answer.ca.as_bytes(), answer.certificate.as_bytes(), key.as_bytes())?;
    credentials.renew(key, answer)?;
    Ok(())
}

/// What the controller gives for a key.
async fn ask(
    (address, config): (&Address, ClientConfig),
    token: Option<&Token>,
    (node, kind): (&str, Kind),
    key: &KeyPair,
) -> Result<JoinAnswer, JoinError> {
    let mut params = CertificateParams::default();
    params.distinguished_name.push(DnType::CommonName, node);
    let csr = params.serialize_request(key).and_then(|csr| csr.pem()).map_err(JoinError::Key)?;
    let kind = match kind {
        Kind::Robot => "Robot",
        Kind::Cloud => "Cloud",
    };
    let token = token.map(|token| token.text.as_str());
    let body = serde_json::to_vec(&JoinRequest { token, node_name: node, kind, csr })
        .map_err(|error| JoinError::Http(error.into()))?;
    let asked = post(address, config, body.into());
    let (status, body) = match tokio::time::timeout(PATIENCE, asked).await {
        Ok(answer) => answer?,
        Err(late) => return Err(JoinError::Http(late.into())),
    };
    if !status.is_success() {
        let message = serde_json::from_slice(&body)
            .map_or_else(|_| "no reason given".to_owned(), |answer: StatusAnswer| answer.message);
        return Err(JoinError::Refused { node: node.to_owned(), status: status.as_u16(), message });
    }
    serde_json::from_slice(&body).map_err(|error| JoinError::Http(error.into()))
}

async fn post(
    address: &Address,
    config: ClientConfig,
    body: Bytes,
) -> Result<(StatusCode, Vec<u8>), JoinError> {
    let stream = tls::connect(address, Arc::new(config)).await.map_err(|error| match &error {
        ConnectError::Tls { source, .. } if is_unknown_issuer(source) => {
            JoinError::WrongCa(address.to_string())
        }
        _ => JoinError::Connect(error),
    })?;
    let http = |error: hyper::Error| JoinError::Http(error.into());
    let (mut sender, connection) =
        hyper::client::conn::http1::handshake(TokioIo::new(stream)).await.map_err(http)?;
    let request = Request::post("/apis/muster.dev/v1alpha1/join")
        .header(header::HOST, address.to_string())
        .header(header::CONTENT_TYPE, "application/json")
        .body(crate::link::join::body::Whole::new(body))
        .map_err(|error| JoinError::Http(error.into()))?;
    let ask = async {
        let response = sender.send_request(request).await.map_err(http)?;
        let (head, mut body) = response.into_parts();
        let mut bytes = Vec::new();
        while let Some(frame) =
            std::future::poll_fn(|context| std::pin::Pin::new(&mut body).poll_frame(context)).await
        {
            if let Ok(data) = frame.map_err(http)?.into_data() {
                bytes.extend_from_slice(&data);
            }
            if bytes.len() > LONGEST_ANSWER {
                return Err(JoinError::Http("the answer has no end".into()));
            }
        }
        Ok((head.status, bytes))
    };
    // The connection has to be driven while the answer is read; it ends with it.
    tokio::select! {
        answer = ask => answer,
        Err(error) = connection.map_err(http) => Err(error),
    }
}

fn is_unknown_issuer(error: &std::io::Error) -> bool {
    let inner = error.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>());
    matches!(
        inner,
        Some(rustls::Error::InvalidCertificate(rustls::CertificateError::UnknownIssuer))
    )
}

/// A request body that is one piece: all that a join needs of a body crate.
mod body {
    use std::convert::Infallible;
    use std::pin::Pin;
    use std::task::{Context, Poll};

    use bytes::Bytes;
    use hyper::body::{Body, Frame, SizeHint};

    pub(super) struct Whole(Option<Bytes>);

    impl Whole {
        pub(super) fn new(bytes: Bytes) -> Whole {
            Whole(Some(bytes))
        }
    }

    impl Body for Whole {
        type Data = Bytes;
        type Error = Infallible;

        fn poll_frame(
            mut self: Pin<&mut Self>,
            _: &mut Context<'_>,
        ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
            Poll::Ready(self.0.take().map(|bytes| Ok(Frame::data(bytes))))
        }

        fn size_hint(&self) -> SizeHint {
            SizeHint::with_exact(self.0.as_ref().map_or(0, Bytes::len) as u64)
        }
    }
}
