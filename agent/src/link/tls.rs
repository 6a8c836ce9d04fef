//! Whom the agent believes, and who it says it is. TLS 1.3 only.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use muster_api::direct::{ALPN, server_name};
use muster_api::wire::READ_BUFFER;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::client::{WebPkiServerVerifier, verify_server_name};
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::server::{ParsedCertificate, WebPkiClientVerifier};
use rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, Error, RootCertStore, ServerConfig,
    SignatureScheme,
};
use tokio::io::BufReader;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use super::Address;

/// A machine that is there answers a first packet by then. The kernel sends it again after 1, 3, 7 s: who has just come back
/// from behind a wall should not wait for the next of those.
const ANSWERS_WITHIN: Duration = Duration::from_secs(2);

/// Why there is no connection.
#[derive(Debug, thiserror::Error)]
pub enum ConnectError {
    /// Nobody answers.
    #[error("failed to reach the controller at {address}")]
    Tcp {
        /// Where.
        address: String,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// Somebody answers that is not the controller the agent knows, or does not know this agent.
    #[error("the controller at {address} and this agent do not trust each other")]
    Tls {
        /// Where.
        address: String,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The host is neither a name nor an address.
    #[error("{0:?} is not a host")]
    Host(String),
    /// The stored key and certificates cannot be used.
    #[error("the stored credentials cannot be used")]
    Credentials(#[source] Error),
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(ring::default_provider())
}

/// Believes only a server whose certificate comes from the CA with this hash.
pub(crate) fn by_hash(ca_hash: [u8; 32]) -> Result<ClientConfig, ConnectError> {
    let verifier = Arc::new(ByHash { ca_hash, provider: provider() });
    let config = ClientConfig::builder_with_provider(provider())
        .with_safe_default_protocol_versions()
        .map_err(ConnectError::Credentials)?
        .dangerous()
        .with_custom_certificate_verifier(verifier)
        .with_no_client_auth();
    Ok(config)
}

/// What a join gave, read.
struct Own {
    roots: RootCertStore,
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
}

impl Own {
    fn read(ca: &[u8], certificate: &[u8], key: &[u8]) -> Result<Own, ConnectError> {
        let bad =
            |_| ConnectError::Credentials(Error::InvalidCertificate(CertificateError::BadEncoding));
        let mut roots = RootCertStore::empty();
        for authority in CertificateDer::pem_slice_iter(ca) {
            roots.add(authority.map_err(bad)?).map_err(ConnectError::Credentials)?;
        }
        let chain: Vec<CertificateDer<'static>> =
            CertificateDer::pem_slice_iter(certificate).collect::<Result<_, _>>().map_err(bad)?;
        let key = PrivateKeyDer::from_pem_slice(key).map_err(bad)?;
        Ok(Own { roots, chain, key })
    }
}

/// From when to when a certificate counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Term {
    pub(crate) from: Timestamp,
    pub(crate) to: Timestamp,
}

/// The term of the first of these certificates (PEM).
pub(crate) fn term(certificates: &[u8]) -> Result<Term, ConnectError> {
    let bad =
        || ConnectError::Credentials(Error::InvalidCertificate(CertificateError::BadEncoding));
    let leaf = CertificateDer::from_pem_slice(certificates).map_err(|_| bad())?;
    let (_, leaf) = x509_parser::parse_x509_certificate(&leaf).map_err(|_| bad())?;
    let time = |at: x509_parser::time::ASN1Time| Timestamp::from_second(at.timestamp());
    let validity = leaf.validity();
    let from = time(validity.not_before).map_err(|_| bad())?;
    Ok(Term { from, to: time(validity.not_after).map_err(|_| bad())? })
}

/// For frameworks that come directly: shows the certificate of `node`, and believes clients of the CA of the join. None: the
/// certificate is of a join before such certificates were for servers as well.
pub(crate) fn serving(
    ca: &[u8],
    certificate: &[u8],
    key: &[u8],
    node: &str,
) -> Result<Option<ServerConfig>, ConnectError> {
    let Own { roots, chain, key } = Own::read(ca, certificate, key)?;
    let for_node = |leaf: &CertificateDer<'_>| {
        let name = ServerName::try_from(server_name(node));
        let leaf = ParsedCertificate::try_from(leaf);
        name.is_ok_and(|name| leaf.is_ok_and(|leaf| verify_server_name(&leaf, &name).is_ok()))
    };
    if !chain.first().is_some_and(for_node) {
        return Ok(None);
    }
    let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider())
        .build()
        .map_err(|error| ConnectError::Credentials(Error::General(error.to_string())))?;
    let mut config = ServerConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(ConnectError::Credentials)?
        .with_client_cert_verifier(verifier)
        .with_single_cert(chain, key)
        .map_err(ConnectError::Credentials)?;
    config.alpn_protocols = vec![ALPN.to_vec()];
    // Nobody comes so often that a handshake would be worth remembering.
    config.send_tls13_tickets = 0;
    Ok(Some(config))
}

/// Believes the CA of the join, and shows this node's certificate.
pub(crate) fn mutual(
    ca: &[u8],
    certificate: &[u8],
    key: &[u8],
) -> Result<ClientConfig, ConnectError> {
    let Own { roots, chain, key } = Own::read(ca, certificate, key)?;
    let mut config = ClientConfig::builder_with_provider(provider())
        .with_safe_default_protocol_versions()
        .map_err(ConnectError::Credentials)?
        .with_root_certificates(roots)
        .with_client_auth_cert(chain, key)
        .map_err(ConnectError::Credentials)?;
    config.alpn_protocols = vec![b"h2".to_vec()];
    Ok(config)
}

/// A connection to the controller.
pub(crate) async fn connect(
    address: &Address,
    config: Arc<ClientConfig>,
) -> Result<TlsStream<BufReader<TcpStream>>, ConnectError> {
    let host = ServerName::try_from(address.host.clone())
        .map_err(|_| ConnectError::Host(address.host.clone()))?;
    let tcp = reach(address)
        .await
        .map_err(|source| ConnectError::Tcp { address: address.to_string(), source })?;
    // Reports and heartbeats are small, and somebody waits for each.
    let _ = tcp.set_nodelay(true);
    TlsConnector::from(config)
        .connect(host, BufReader::with_capacity(READ_BUFFER, tcp))
        .await
        .map_err(|source| ConnectError::Tls { address: address.to_string(), source })
}

/// The first of the host's addresses that answers.
async fn reach(address: &Address) -> io::Result<TcpStream> {
    let mut failed = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    for found in tokio::net::lookup_host((address.host.as_str(), address.port)).await? {
        match tokio::time::timeout(ANSWERS_WITHIN, TcpStream::connect(found)).await {
            Ok(Ok(tcp)) => return Ok(tcp),
            Ok(Err(error)) => failed = error,
            Err(_) => failed = io::ErrorKind::TimedOut.into(),
        }
    }
    Err(failed)
}

/// SHA-256.
pub(crate) fn sha256(bytes: &[u8]) -> [u8; 32] {
    let digest = ::ring::digest::digest(&::ring::digest::SHA256, bytes);
    let mut hash = [0; 32];
    hash.copy_from_slice(digest.as_ref());
    hash
}

#[derive(Debug)]
struct ByHash {
    ca_hash: [u8; 32],
    provider: Arc<CryptoProvider>,
}

impl ServerCertVerifier for ByHash {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        server_name: &ServerName<'_>,
        ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let authority = intermediates
            .iter()
            .find(|certificate| sha256(certificate) == self.ca_hash)
            .ok_or(Error::InvalidCertificate(CertificateError::UnknownIssuer))?;
        let mut roots = RootCertStore::empty();
        roots.add(authority.clone().into_owned())?;
        let verifier = WebPkiServerVerifier::builder_with_provider(
            Arc::new(roots),
            Arc::clone(&self.provider),
        )
        .build()
        .map_err(|error| Error::General(error.to_string()))?;
        verifier.verify_server_cert(end_entity, intermediates, server_name, ocsp_response, now)
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(Error::General("TLS 1.2 is not spoken here".to_owned()))
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        rustls::crypto::verify_tls13_signature(message, cert, dss, algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider.signature_verification_algorithms.supported_schemes()
    }
}
