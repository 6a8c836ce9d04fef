//! The publishers: streams of their own connections, that send batches which are encoded already, so that the load
//! costs the other core as little as it can.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;

use bytes::{Buf as _, BufMut as _, Bytes};
use http::Uri;
use http::uri::PathAndQuery;
use hyper_util::rt::TokioIo;
use muster_api::wire::pose::v1::{NodePose, PoseBatch, PoseReply};
use prost::Message as _;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio_rustls::TlsConnector;
use tokio_stream::wrappers::ReceiverStream;
use tonic::client::Grpc;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Status, Streaming};

#[derive(Debug, Default)]
struct Encoded;

impl Codec for Encoded {
    type Encode = Bytes;
    type Decode = PoseReply;
    type Encoder = Encoded;
    type Decoder = Encoded;

    fn encoder(&mut self) -> Encoded {
        Encoded
    }

    fn decoder(&mut self) -> Encoded {
        Encoded
    }
}

impl Encoder for Encoded {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, item: Bytes, to: &mut EncodeBuf<'_>) -> Result<(), Status> {
        to.put(item);
        Ok(())
    }
}

impl Decoder for Encoded {
    type Item = PoseReply;
    type Error = Status;

    fn decode(&mut self, from: &mut DecodeBuf<'_>) -> Result<Option<PoseReply>, Status> {
        let all = from.copy_to_bytes(from.remaining());
        PoseReply::decode(all).map(Some).map_err(|e| Status::internal(e.to_string()))
    }
}

/// TLS as the administrator of the controller whose PKI this is.
pub(crate) fn admin(pki: &Path) -> Arc<ClientConfig> {
    let certificate =
        |name: &str| CertificateDer::from_pem_file(pki.join(name)).expect("the controller made it");
    let mut roots = RootCertStore::empty();
    roots.add(certificate("ca.crt")).expect("a CA");
    let key = PrivateKeyDer::from_pem_file(pki.join("admin.key")).expect("the controller made it");
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut config = ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("ring knows it")
        .with_root_certificates(roots)
        .with_client_auth_cert(vec![certificate("admin.crt")], key)
        .expect("they belong together");
    config.alpn_protocols = vec![b"h2".to_vec()];
    Arc::new(config)
}

/// A connection of its own to the controller.
pub(crate) async fn dial(
    address: SocketAddr,
    tls: Arc<ClientConfig>,
) -> Result<Channel, tonic::transport::Error> {
    let connect = tower::service_fn(move |_: Uri| {
        let connector = TlsConnector::from(Arc::clone(&tls));
        async move {
            let stream = TcpStream::connect(address).await?;
            stream.set_nodelay(true)?;
            let name = ServerName::IpAddress(address.ip().into());
            connector.connect(name, stream).await.map(TokioIo::new)
        }
    });
    Endpoint::from_shared(format!("http://{address}"))?.connect_with_connector(connect).await
}

/// One publisher.
pub(crate) struct Stream {
    batches: mpsc::Sender<Bytes>,
    replies: Streaming<PoseReply>,
}

impl Stream {
    pub(crate) async fn open(address: SocketAddr, tls: Arc<ClientConfig>) -> Self {
        let channel = dial(address, tls).await.expect("a connection");
        let (batches, queue) = mpsc::channel(4);
        let mut client = Grpc::new(channel);
        client.ready().await.expect("a connection");
        let path = PathAndQuery::from_static("/muster.pose.v1.PoseService/Publish");
        let request = Request::new(ReceiverStream::new(queue));
        let answer = client.streaming(request, path, Encoded).await.expect("a stream");
        Stream { batches, replies: answer.into_inner() }
    }

    pub(crate) async fn send(&self, batch: Bytes) {
        self.batches.send(batch).await.expect("the stream is open");
    }

    /// Waits for the reply to a batch that asked for one; everything before it has been taken as well.
    pub(crate) async fn reply(&mut self) -> PoseReply {
        self.replies.message().await.expect("the stream is open").expect("it goes on")
    }
}

/// A batch as it goes over the wire.
pub(crate) fn batch(poses: Vec<NodePose>, acknowledge: bool) -> Bytes {
    let (source, map) = ("mocap".to_owned(), "hall".to_owned());
    PoseBatch { sequence: 1, source, map, poses, acknowledge }.encode_to_vec().into()
}
