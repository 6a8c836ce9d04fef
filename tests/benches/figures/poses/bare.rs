//! The floor: a server that only takes the same stream of messages, with the controller's own TLS.
//!
//! It is this program again, as a process of its own on the same core: `figures bare-stream PKI-DIR`. It prints its
//! address, and ends when its standard input does.

use std::io::Read as _;
use std::path::Path;
use std::sync::Arc;

use axum::Router;
use axum::extract::Request;
use axum::response::IntoResponse;
use axum::routing::post;
use futures::future::BoxFuture;
use hyper_util::rt::{TokioExecutor, TokioIo};
use hyper_util::server::conn::auto::Builder;
use hyper_util::service::TowerToHyperService;
use muster_api::wire::pose::v1::{PoseBatch, PoseReply};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_rustls::TlsAcceptor;
use tokio_stream::wrappers::ReceiverStream;
use tonic::server::{Grpc, StreamingService};
use tonic::{Response, Status, Streaming};
use tonic_prost::ProstCodec;

/// Takes batches and acknowledges those that ask for it, as the controller does.
struct Take;

impl StreamingService<PoseBatch> for Take {
    type Response = PoseReply;
    type ResponseStream = ReceiverStream<Result<PoseReply, Status>>;
    type Future = BoxFuture<'static, Result<Response<Self::ResponseStream>, Status>>;

    fn call(&mut self, request: tonic::Request<Streaming<PoseBatch>>) -> Self::Future {
        let (replies, outbound) = mpsc::channel(64);
        let mut inbound = request.into_inner();
        tokio::spawn(async move {
            while let Ok(Some(batch)) = inbound.message().await {
                if batch.acknowledge {
                    let taken = u32::try_from(batch.poses.len()).unwrap_or(u32::MAX);
                    let reply = PoseReply { sequence: batch.sequence, taken, refused: Vec::new() };
                    drop(replies.try_send(Ok(reply)));
                }
            }
        });
        Box::pin(std::future::ready(Ok(Response::new(ReceiverStream::new(outbound)))))
    }
}

async fn publish(request: Request) -> axum::response::Response {
    let codec = ProstCodec::<PoseReply, PoseBatch>::default();
    Grpc::new(codec).streaming(Take, request).await.into_response()
}

fn tls(pki: &Path) -> ServerConfig {
    let certificate =
        |name: &str| CertificateDer::from_pem_file(pki.join(name)).expect("the controller made it");
    let mut roots = RootCertStore::empty();
    roots.add(certificate("ca.crt")).expect("a CA");
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let verifier =
        WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&provider));
    let verifier = verifier.allow_unauthenticated().build().expect("a verifier");
    let key = PrivateKeyDer::from_pem_file(pki.join("server.key")).expect("the controller made it");
    let mut config = ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("ring knows it")
        .with_client_cert_verifier(verifier)
        .with_single_cert(vec![certificate("server.crt"), certificate("ca.crt")], key)
        .expect("they belong together");
    config.alpn_protocols = vec![b"h2".to_vec()];
    config
}

/// Serves until standard input ends.
pub(crate) async fn serve(pki: &Path) {
    let acceptor = TlsAcceptor::from(Arc::new(tls(pki)));
    let router = Router::new().route("/muster.pose.v1.PoseService/Publish", post(publish));
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback");
    println!("{}", listener.local_addr().expect("bound"));
    let accept = async {
        loop {
            let (stream, _) = listener.accept().await.expect("a connection");
            stream.set_nodelay(true).expect("TCP");
            let (acceptor, router) = (acceptor.clone(), router.clone());
            tokio::spawn(async move {
                let stream = acceptor.accept(stream).await.expect("TLS");
                let builder = Builder::new(TokioExecutor::new());
                let service = TowerToHyperService::new(router);
                // A client that goes away in the middle ends its connection with an error.
                drop(builder.serve_connection(TokioIo::new(stream), service).await);
            });
        }
    };
    let parent_gone = tokio::task::spawn_blocking(|| std::io::stdin().read_to_end(&mut Vec::new()));
    tokio::select! {
        () = accept => {}
        _ = parent_gone => {}
    }
}
