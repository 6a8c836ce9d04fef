//! Whom the framework believes, and who it says it is.

use std::sync::Arc;
use std::time::Duration;

use hyper_util::rt::TokioIo;
use muster_api::direct::ALPN;
use muster_api::wire::{HTTP2_FRAME, HTTP2_WINDOW, READ_BUFFER};
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{CertificateError, CipherSuite, ClientConfig, Error, RootCertStore};
use tokio::io::BufReader;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tonic::transport::{Channel, Endpoint};

use super::kubeconfig::Address;

/// A connection in one building is up in milliseconds, over a bad radio link in seconds.
const PATIENCE: Duration = Duration::from_secs(10);

/// Certificate and key, PEM; none: whoever asks says who they are by a token.
type Pair<'a> = Option<(&'a [u8], &'a [u8])>;

/// For the controller.
pub(crate) fn mutual(ca: &[u8], pair: Pair<'_>) -> Result<ClientConfig, Error> {
    config(ring::default_provider(), b"h2", (ca, pair))
}

/// For agents. Of the ciphers the one with the shorter key comes first: it is as good, and large messages are what these
/// connections are for.
pub(crate) fn direct(ca: &[u8], pair: Pair<'_>) -> Result<ClientConfig, Error> {
    let mut provider = ring::default_provider();
    provider
        .cipher_suites
        .sort_by_key(|suite| suite.suite() != CipherSuite::TLS13_AES_128_GCM_SHA256);
    config(provider, ALPN, (ca, pair))
}

/// Believes the kubeconfig's CA and shows its client certificate, where there is one.
fn config(
    provider: CryptoProvider,
    protocol: &[u8],
    (ca, pair): (&[u8], Pair<'_>),
) -> Result<ClientConfig, Error> {
    let bad = |_| Error::InvalidCertificate(CertificateError::BadEncoding);
    let mut roots = RootCertStore::empty();
    for authority in CertificateDer::pem_slice_iter(ca) {
        roots.add(authority.map_err(bad)?)?;
    }
    let builder = ClientConfig::builder_with_provider(Arc::new(provider))
        .with_safe_default_protocol_versions()?
        .with_root_certificates(roots);
    let mut config = match pair {
        None => builder.with_no_client_auth(),
        Some((certificate, key)) => {
            let chain = CertificateDer::pem_slice_iter(certificate);
            let chain: Vec<CertificateDer<'static>> =
                chain.collect::<Result<_, _>>().map_err(bad)?;
            let key = PrivateKeyDer::from_pem_slice(key).map_err(bad)?;
            builder.with_client_auth_cert(chain, key)?
        }
    };
    config.alpn_protocols = vec![protocol.to_vec()];
    Ok(config)
}

/// An HTTP/2 connection to the controller.
pub(crate) async fn dial(
    address: &Address,
    tls: &Arc<ClientConfig>,
) -> Result<Channel, tonic::transport::Error> {
    let endpoint = Endpoint::from_shared(format!("http://{address}"))?
        .connect_timeout(PATIENCE)
        .initial_stream_window_size(HTTP2_WINDOW)
        .initial_connection_window_size(HTTP2_WINDOW)
        .max_frame_size(HTTP2_FRAME);
    let (address, tls) = (address.clone(), Arc::clone(tls));
    let connector = tower::service_fn(move |_: http::Uri| {
        let (address, tls) = (address.clone(), Arc::clone(&tls));
        async move { connect(&address, tls).await.map(TokioIo::new) }
    });
    endpoint.connect_with_connector(connector).await
}

async fn connect(
    address: &Address,
    tls: Arc<ClientConfig>,
) -> std::io::Result<TlsStream<BufReader<TcpStream>>> {
    let host = ServerName::try_from(address.host.clone()).map_err(std::io::Error::other)?;
    let tcp = TcpStream::connect((address.host.as_str(), address.port)).await?;
    // Calls are small, and somebody waits for each. Without it they are only slower.
    let _ = tcp.set_nodelay(true);
    TlsConnector::from(tls).connect(host, BufReader::with_capacity(READ_BUFFER, tcp)).await
}
