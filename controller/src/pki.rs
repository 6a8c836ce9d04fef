//! The controller's own certificate authority: made at the first start, kept in the data directory.
//!
//! ```text
//! DIR/pki/ca.crt ca.key          ten years; its SHA-256 is part of every join token
//! DIR/pki/server.crt server.key  presented as leaf + CA; made anew when names change or it nears its end, also while the controller runs
//! DIR/pki/admin.crt admin.key    O=muster:admins, what the kubeconfig holds
//! ```
//! A key is written before its certificate, and only a certificate makes a pair count, so a crash in between leaves
//! nothing half-made. Agents get `O=muster:nodes, CN=muster:node:NAME`: of their request only the key is used.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::net::IpAddr;
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use muster_api::direct::server_name;
use muster_failpoint::{Failpoint, Step, reach};
use rcgen::{
    BasicConstraints, CertificateParams, CertificateSigningRequestParams, DistinguishedName,
    DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose,
};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig};
use x509_parser::extensions::GeneralName;

/// `O` of administrators.
pub const ADMINS: &str = "muster:admins";
/// `O` of agents.
pub const NODES: &str = "muster:nodes";
/// What the `CN` of an agent begins with; the node's name follows.
pub const NODE_PREFIX: &str = "muster:node:";

const CA_DAYS: i64 = 3650;
/// How long a certificate counts that is not the CA's.
pub const TTL: Duration = Duration::from_secs(365 * 24 * 3600);
/// How long before its making a certificate counts at most: the clock of a joining agent may be a little behind.
const BEFORE: Duration = Duration::from_secs(24 * 3600);

/// Why certificates could not be made or read.
#[derive(Debug, thiserror::Error)]
pub enum PkiError {
    /// A file could not be read or written.
    #[error("cannot access {}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// A file does not hold what it should.
    #[error("{} does not hold a usable certificate or key", path.display())]
    Damaged {
        /// Which.
        path: PathBuf,
    },
    /// A certificate could not be made.
    #[error("cannot make a certificate")]
    Make(#[from] rcgen::Error),
    /// TLS does not take what was made.
    #[error("cannot set up TLS")]
    Tls(#[from] rustls::Error),
    /// The client verifier does not take the CA.
    #[error("cannot verify client certificates")]
    Verifier(#[from] rustls::server::VerifierBuilderError),
}

/// A certificate and its key, both as PEM.
#[derive(Clone)]
pub(crate) struct Pem {
    pub(crate) certificate: String,
    pub(crate) key: String,
}

/// The certificate authority.
pub struct Pki {
    dir: PathBuf,
    ca: String,
    ca_der: CertificateDer<'static>,
    issuer: Issuer<'static, KeyPair>,
    ttl: Duration,
}

impl std::fmt::Debug for Pki {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pki").field("dir", &self.dir).finish_non_exhaustive()
    }
}

impl Pki {
    /// Opens the authority in `dir`, or makes it.
    ///
    /// # Errors
    /// When a file cannot be read or written, or holds something else.
    pub fn open(dir: &Path, now: Timestamp) -> Result<Self, PkiError> {
        let failed = |source| PkiError::File { path: dir.to_owned(), source };
        fs::DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(failed)?;
        let pair = match read_pair(dir, "ca")? {
            Some(pair) => pair,
            None => make_ca(dir, now)?,
        };
        let damaged = || PkiError::Damaged { path: dir.join("ca.crt") };
        let key = KeyPair::from_pem(&pair.key).map_err(|_| damaged())?;
        let issuer = Issuer::from_ca_cert_pem(&pair.certificate, key).map_err(|_| damaged())?;
        let ca_der =
            CertificateDer::from_pem_slice(pair.certificate.as_bytes()).map_err(|_| damaged())?;
        Ok(Self { dir: dir.to_owned(), ca: pair.certificate, ca_der, issuer, ttl: TTL })
    }

    /// The same, for certificates that count so long.
    #[must_use]
    pub fn with_ttl(self, ttl: Duration) -> Self {
        Self { ttl, ..self }
    }

    /// The CA's certificate as PEM.
    #[must_use]
    pub fn ca(&self) -> &str {
        &self.ca
    }

    /// SHA-256 of the CA's certificate (DER), in hex: what a join token carries.
    #[must_use]
    pub fn ca_hash(&self) -> String {
        hex(ring::digest::digest(&ring::digest::SHA256, &self.ca_der).as_ref())
    }

    /// The administrator's certificate, made anew when it nears its end.
    pub(crate) fn admin(&self, now: Timestamp) -> Result<Pem, PkiError> {
        self.keep(
            ("admin", Failpoint::AdminPair),
            now,
            |_| true,
            || client_params("admin", ADMINS, (now, self.ttl)),
        )
    }

    /// The server's certificate, made anew when it nears its end. `names` are the names and addresses that clients may dial.
    pub(crate) fn server(&self, names: &BTreeSet<String>, now: Timestamp) -> Result<Pem, PkiError> {
        let fits = |present: &BTreeSet<String>| present == names;
        self.keep(("server", Failpoint::ServerPair), now, fits, || {
            server_params(names, (now, self.ttl))
        })
    }

    /// TLS for the one port, with the server's certificate.
    pub(crate) fn server_config(&self, pair: &Pem) -> Result<ServerConfig, PkiError> {
        let damaged = || PkiError::Damaged { path: self.dir.join("server.crt") };
        let leaf =
            CertificateDer::from_pem_slice(pair.certificate.as_bytes()).map_err(|_| damaged())?;
        let key = PrivateKeyDer::from_pem_slice(pair.key.as_bytes()).map_err(|_| damaged())?;
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let mut roots = RootCertStore::empty();
        roots.add(self.ca_der.clone())?;
        let verifier =
            WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&provider))
                .allow_unauthenticated()
                .build()?;
        let mut config = ServerConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])?
            .with_client_cert_verifier(verifier)
            // The CA goes along so that a joining agent can hold it against the hash in its token.
            .with_single_cert(vec![leaf, self.ca_der.clone()], key)?;
        config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
        // A session that is resumed has the certificate of its beginning, which may not count any more.
        config.session_storage = Arc::new(rustls::server::NoServerSessionStorage {});
        config.send_tls13_tickets = 0;
        Ok(config)
    }

    /// Signs the key in an agent's request for the node `name`; everything else in the request is ignored.
    ///
    /// # Errors
    /// [`PkiError::Make`] when the request cannot be read or its signature is wrong.
    pub fn sign_node(&self, name: &str, csr: &str, now: Timestamp) -> Result<String, PkiError> {
        let public_key = CertificateSigningRequestParams::from_pem(csr)?.public_key;
        let params = node_params(name, (now, self.ttl))?;
        let signed =
            CertificateSigningRequestParams { params, public_key }.signed_by(&self.issuer)?;
        Ok(signed.pem())
    }

    /// The pair `name`, made anew when it is missing, nears its end or does not fit.
    fn keep(
        &self,
        (name, point): (&str, Failpoint),
        now: Timestamp,
        fits: impl Fn(&BTreeSet<String>) -> bool,
        params: impl Fn() -> Result<CertificateParams, PkiError>,
    ) -> Result<Pem, PkiError> {
        if let Some(pair) = read_pair(&self.dir, name)?
            && let Some((names, [begins, ends])) = inspect(&pair.certificate)
            // Made by a clock that was wrong, it would count for nobody until then.
            && begins <= now.as_second()
            && ends - now.as_second() > self.ttl.as_secs().cast_signed() / 3
            && fits(&names)
        {
            return Ok(pair);
        }
        let key = KeyPair::generate()?;
        let certificate = params()?.signed_by(&key, &self.issuer)?;
        let pair = Pem { certificate: certificate.pem(), key: key.serialize_pem() };
        write_pair((&self.dir, name), point, &pair)?;
        Ok(pair)
    }
}

fn make_ca(dir: &Path, now: Timestamp) -> Result<Pem, PkiError> {
    let ttl = Duration::from_secs(CA_DAYS.unsigned_abs() * 24 * 3600);
    let mut params = valid(CertificateParams::default(), (now, ttl));
    params.distinguished_name = subject("muster", "muster");
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::DigitalSignature];
    let key = KeyPair::generate()?;
    let pair = Pem { certificate: params.self_signed(&key)?.pem(), key: key.serialize_pem() };
    write_pair((dir, "ca"), Failpoint::CaPair, &pair)?;
    Ok(pair)
}

/// From when, and for how long.
type Term = (Timestamp, Duration);

fn client_params(cn: &str, o: &str, term: Term) -> Result<CertificateParams, PkiError> {
    let mut params = valid(CertificateParams::default(), term);
    params.distinguished_name = subject(cn, o);
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
    params.use_authority_key_identifier_extension = true;
    Ok(params)
}

/// An agent is a client of the controller, and a server for frameworks that exchange messages with its executors.
fn node_params(name: &str, term: Term) -> Result<CertificateParams, PkiError> {
    let mut params = client_params(&format!("{NODE_PREFIX}{name}"), NODES, term)?;
    let server = CertificateParams::new(vec![server_name(name)])?;
    params.subject_alt_names = server.subject_alt_names;
    params.extended_key_usages.push(ExtendedKeyUsagePurpose::ServerAuth);
    Ok(params)
}

fn server_params(names: &BTreeSet<String>, term: Term) -> Result<CertificateParams, PkiError> {
    let names: Vec<String> = names.iter().cloned().collect();
    let mut params = valid(CertificateParams::new(names)?, term);
    params.distinguished_name = subject("muster-controller", "muster");
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    params.use_authority_key_identifier_extension = true;
    Ok(params)
}

fn subject(cn: &str, o: &str) -> DistinguishedName {
    let mut name = DistinguishedName::new();
    name.push(DnType::OrganizationName, o);
    name.push(DnType::CommonName, cn);
    name
}

/// Valid from some time before, a day at most.
fn valid(mut params: CertificateParams, (now, ttl): Term) -> CertificateParams {
    let epoch = rcgen::date_time_ymd(1970, 1, 1);
    let since = |at: i64| epoch + Duration::from_secs(at.max(0).unsigned_abs());
    let seconds = |span: Duration| span.as_secs().cast_signed();
    params.not_before = since(now.as_second() - seconds((ttl / 10).min(BEFORE)));
    params.not_after = since(now.as_second() + seconds(ttl));
    params
}

/// The alternative names of a certificate, and when it begins and ends to count (seconds since the epoch).
fn inspect(pem: &str) -> Option<(BTreeSet<String>, [i64; 2])> {
    let der = CertificateDer::from_pem_slice(pem.as_bytes()).ok()?;
    let (_, certificate) = x509_parser::parse_x509_certificate(&der).ok()?;
    let names = certificate.subject_alternative_name().ok().flatten();
    let names =
        names.iter().flat_map(|names| &names.value.general_names).filter_map(|name| match name {
            GeneralName::DNSName(name) => Some((*name).to_owned()),
            GeneralName::IPAddress(bytes) => match bytes.len() {
                4 => <[u8; 4]>::try_from(*bytes).ok().map(|a| IpAddr::from(a).to_string()),
                _ => <[u8; 16]>::try_from(*bytes).ok().map(|a| IpAddr::from(a).to_string()),
            },
            _ => None,
        });
    let term = certificate.validity();
    Some((names.collect(), [term.not_before, term.not_after].map(|time| time.timestamp())))
}

fn read_pair(dir: &Path, name: &str) -> Result<Option<Pem>, PkiError> {
    let Some(certificate) = read(&dir.join(format!("{name}.crt")))? else { return Ok(None) };
    let path = dir.join(format!("{name}.key"));
    let Some(key) = read(&path)? else { return Err(PkiError::Damaged { path }) };
    Ok(Some(Pem { certificate, key }))
}

fn read(path: &Path) -> Result<Option<String>, PkiError> {
    match fs::read_to_string(path) {
        Ok(text) => Ok(Some(text)),
        Err(source) if source.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(PkiError::File { path: path.to_owned(), source }),
    }
}

fn write_pair((dir, name): (&Path, &str), point: Failpoint, pair: &Pem) -> Result<(), PkiError> {
    reach(point, Step::Before);
    let parts = ["key", "crt"].map(|part| {
        let path = dir.join(format!("{name}.{part}"));
        (path.with_added_extension("new"), path)
    });
    for ((new, _), text) in parts.iter().zip([&pair.key, &pair.certificate]) {
        write_private(point, new, text.as_bytes())?;
    }
    // An old certificate beside the new key would be a pair that does not fit. What there is goes when the disk has the new.
    let [_, (_, certificate)] = &parts;
    match fs::remove_file(certificate) {
        Err(source) if source.kind() != io::ErrorKind::NotFound => {
            return Err(PkiError::File { path: certificate.clone(), source });
        }
        _ => {}
    }
    for ((new, path), step) in parts.into_iter().zip([Step::Removed, Step::Half]) {
        reach(point, step);
        let failed = |source| PkiError::File { path: path.clone(), source };
        fs::rename(&new, &path).map_err(failed)?;
        File::open(dir).and_then(|dir| dir.sync_all()).map_err(failed)?;
    }
    reach(point, Step::After);
    Ok(())
}

/// Writes a file whole or not at all, readable by its owner only. `point`: what it is, or is a part of.
pub(crate) fn write_private(point: Failpoint, path: &Path, bytes: &[u8]) -> Result<(), PkiError> {
    let failed = |source| PkiError::File { path: path.to_owned(), source };
    let parent = path.parent().filter(|dir| !dir.as_os_str().is_empty());
    let dir = parent.unwrap_or_else(|| Path::new("."));
    fs::DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(failed)?;
    sweep(dir, path);
    let temporary = path.with_added_extension(format!("{}.tmp", std::process::id()));
    let write = || -> io::Result<()> {
        let mut file = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(true)
            .mode(0o600)
            .open(&temporary)?;
        reach(point, Step::Created);
        file.write_all(bytes)?;
        file.sync_all()?;
        reach(point, Step::Written);
        fs::rename(&temporary, path)?;
        File::open(dir)?.sync_all()
    };
    write().map_err(|source| {
        // What is left of a failed write is of no use, and the failure is what the caller must hear of.
        drop(fs::remove_file(&temporary));
        failed(source)
    })
}

/// Removes what a writer of this file left that was killed. Two controllers may write one kubeconfig: the file of one that
/// lives stays.
fn sweep(dir: &Path, path: &Path) {
    let Some(name) = path.file_name().and_then(OsStr::to_str) else { return };
    for entry in fs::read_dir(dir).into_iter().flatten().flatten() {
        let found = entry.file_name();
        let writer = found.to_str().and_then(|found| {
            found.strip_prefix(name)?.strip_prefix('.')?.strip_suffix(".tmp")?.parse::<u32>().ok()
        });
        if writer.is_some_and(|pid| !Path::new("/proc").join(pid.to_string()).exists()) {
            // What stays is no harm but the room that it takes.
            drop(fs::remove_file(entry.path()));
        }
    }
}

/// Lower-case hex.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn now() -> Timestamp {
        "2026-11-22T12:00:00Z".parse().unwrap()
    }

    fn names(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn pairs_are_kept_until_they_near_their_end_or_names_change() {
        let dir = tempfile::tempdir().unwrap();
        let pki = Pki::open(dir.path(), now()).unwrap();
        let first = pki.admin(now()).unwrap();
        let again = Pki::open(dir.path(), now()).unwrap();
        assert_eq!(again.ca_hash(), pki.ca_hash());
        assert_eq!(again.admin(now()).unwrap().certificate, first.certificate);
        let at = |part: u32| now() + jiff::SignedDuration::try_from(TTL * part / 6).unwrap();
        assert_eq!(again.admin(at(3)).unwrap().certificate, first.certificate);
        let second = again.admin(at(5)).unwrap();
        assert_ne!(second.certificate, first.certificate);
        assert_eq!(again.admin(at(8)).unwrap().certificate, second.certificate);
        // A clock that was ahead is right again: what was made by it does not count yet.
        assert_ne!(again.admin(now()).unwrap().certificate, second.certificate);

        let server = |hosts: &[&str]| pki.server(&names(hosts), now()).unwrap().certificate;
        let one = server(&["localhost", "127.0.0.1", "::1"]);
        assert_eq!(server(&["localhost", "127.0.0.1", "::1"]), one);
        assert_ne!(server(&["localhost", "127.0.0.1", "::1", "lab.example"]), one);
    }

    #[test]
    fn keys_are_for_their_owner_only() {
        use std::os::unix::fs::PermissionsExt as _;
        let dir = tempfile::tempdir().unwrap();
        Pki::open(dir.path(), now()).unwrap();
        let mode = fs::metadata(dir.path().join("ca.key")).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }

    #[test]
    fn a_key_without_its_certificate_is_made_anew() {
        let dir = tempfile::tempdir().unwrap();
        let pki = Pki::open(dir.path(), now()).unwrap();
        pki.admin(now()).unwrap();
        fs::remove_file(dir.path().join("admin.crt")).unwrap();
        pki.admin(now()).unwrap();
        fs::remove_file(dir.path().join("admin.key")).unwrap();
        assert!(matches!(pki.admin(now()), Err(PkiError::Damaged { .. })));
    }

    #[test]
    fn of_a_request_only_the_key_is_used() {
        let dir = tempfile::tempdir().unwrap();
        let pki = Pki::open(dir.path(), now()).unwrap();
        let key = KeyPair::generate().unwrap();
        let mut wish = CertificateParams::new(vec!["evil.example".to_owned()]).unwrap();
        wish.distinguished_name = subject("admin", ADMINS);
        let csr = wish.serialize_request(&key).unwrap().pem().unwrap();
        let pem = pki.sign_node("turtlebot-1", &csr, now()).unwrap();
        let der = CertificateDer::from_pem_slice(pem.as_bytes()).unwrap();
        let (_, certificate) = x509_parser::parse_x509_certificate(&der).unwrap();
        assert_eq!(certificate.subject().to_string(), "O=muster:nodes, CN=muster:node:turtlebot-1");
        let (names, _) = inspect(&pem).unwrap();
        assert_eq!(names, BTreeSet::from(["turtlebot-1.nodes.muster.dev".to_owned()]));
        let usage = certificate.extended_key_usage().unwrap().unwrap().value;
        assert!(usage.client_auth && usage.server_auth);
        assert!(!certificate.is_ca());
        assert!(pki.sign_node("x", "not a request", now()).is_err());
    }
}
