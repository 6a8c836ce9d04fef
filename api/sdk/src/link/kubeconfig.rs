//! Which controller is dialled, and as whom: the part of a kubeconfig that a framework needs. The `kube` client, which
//! reads all of it, would bring its whole HTTP stack along.
//!
//! Looked for as the `muster` command does: a path that is named, `MUSTER_CONFIG`, `KUBECONFIG`, `~/.muster/config`.

use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use http::Uri;
use rustls::ClientConfig;
use serde::Deserialize;
use tonic::Request;
use tonic::metadata::{Ascii, MetadataValue};

use super::tls;
use crate::KubeconfigError;

/// The port that the controller listens on when nobody says otherwise.
const PORT: u16 = 7443;

/// Where the controller is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Address {
    pub(crate) host: String,
    pub(crate) port: u16,
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.host.contains(':') {
            write!(f, "[{}]:{}", self.host, self.port)
        } else {
            write!(f, "{}:{}", self.host, self.port)
        }
    }
}

fn address(server: &str) -> Result<Address, KubeconfigError> {
    let bad = || KubeconfigError::Server(server.to_owned());
    let uri: Uri = server.parse().map_err(|_| bad())?;
    match (uri.scheme_str(), uri.host(), uri.path()) {
        (Some("https"), Some(host), "" | "/") => {
            let host = host.trim_start_matches('[').trim_end_matches(']').to_owned();
            Ok(Address { host, port: uri.port_u16().unwrap_or(PORT) })
        }
        _ => Err(bad()),
    }
}

/// What was found.
pub(crate) struct Target {
    pub(crate) address: Address,
    /// The context's.
    pub(crate) namespace: Option<String>,
    ca: Vec<u8>,
    /// Certificate and key; none: the token says who asks.
    pair: Option<Pair>,
    /// What is sent with each call; it counts before a certificate.
    pub(crate) authorization: Option<Authorization>,
}

/// A certificate and its key, PEM.
type Pair = (Vec<u8>, Vec<u8>);

/// `Bearer TOKEN`, and no log shows it.
pub(crate) type Authorization = MetadataValue<Ascii>;

/// A request in somebody's name.
pub(crate) fn authorized<T>(message: T, authorization: Option<&Authorization>) -> Request<T> {
    let mut request = Request::new(message);
    if let Some(authorization) = authorization {
        request.metadata_mut().insert("authorization", authorization.clone());
    }
    request
}

impl Target {
    /// TLS with the credentials of the kubeconfig.
    pub(crate) fn tls(&self) -> Result<ClientConfig, rustls::Error> {
        tls::mutual(&self.ca, self.pair())
    }

    /// The same, for agents that are dialled directly.
    pub(crate) fn direct_tls(&self) -> Result<ClientConfig, rustls::Error> {
        tls::direct(&self.ca, self.pair())
    }

    /// Whether agents can be dialled: they ask for a certificate.
    pub(crate) fn has_certificate(&self) -> bool {
        self.pair.is_some()
    }

    fn pair(&self) -> Option<(&[u8], &[u8])> {
        self.pair.as_ref().map(|(certificate, key)| (&certificate[..], &key[..]))
    }
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "kebab-case", default)]
struct File {
    current_context: String,
    clusters: Vec<NamedCluster>,
    users: Vec<NamedUser>,
    contexts: Vec<NamedContext>,
}

#[derive(Debug, Deserialize)]
struct NamedCluster {
    name: String,
    cluster: Cluster,
}

#[derive(Debug, Deserialize)]
struct NamedUser {
    name: String,
    user: User,
}

#[derive(Debug, Deserialize)]
struct NamedContext {
    name: String,
    context: Context,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "kebab-case")]
struct Cluster {
    server: String,
    certificate_authority: Option<PathBuf>,
    certificate_authority_data: Option<String>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "kebab-case")]
struct User {
    client_certificate: Option<PathBuf>,
    client_certificate_data: Option<String>,
    client_key: Option<PathBuf>,
    client_key_data: Option<String>,
    token: Option<String>,
}

#[derive(Debug, Deserialize)]
struct Context {
    cluster: String,
    user: String,
    namespace: Option<String>,
}

/// The files to read; where they differ the first one wins.
pub(crate) fn files(named: Option<&Path>) -> Vec<PathBuf> {
    files_from(named, |name| std::env::var_os(name), std::env::home_dir())
}

fn files_from(
    named: Option<&Path>,
    env: impl Fn(&str) -> Option<OsString>,
    home: Option<PathBuf>,
) -> Vec<PathBuf> {
    if let Some(path) = named {
        return vec![path.to_owned()];
    }
    for variable in ["MUSTER_CONFIG", "KUBECONFIG"] {
        let Some(value) = env(variable) else { continue };
        let files: Vec<PathBuf> =
            std::env::split_paths(&value).filter(|path| !path.as_os_str().is_empty()).collect();
        if !files.is_empty() {
            return files;
        }
    }
    vec![home.unwrap_or_else(|| PathBuf::from(".")).join(".muster").join("config")]
}

/// Reads the current context of the files.
pub(crate) fn load(files: &[PathBuf]) -> Result<Target, KubeconfigError> {
    // As kubectl does with KUBECONFIG: a list may name files that are not there, a single file must be.
    let several = files.len() > 1;
    let mut merged = File::default();
    for path in files.iter().filter(|path| !several || path.exists()) {
        merged = merge(merged, read(path)?);
    }
    target(merged)
}

fn read(path: &Path) -> Result<File, KubeconfigError> {
    let text = read_bytes(path)?;
    let syntax = |source: Box<dyn std::error::Error + Send + Sync>| KubeconfigError::Syntax {
        path: path.to_owned(),
        source,
    };
    let text = String::from_utf8(text).map_err(|error| syntax(error.into()))?;
    let mut file: File = serde_saphyr::from_str(&text).map_err(|error| syntax(error.into()))?;
    // Paths in a kubeconfig are relative to it.
    let dir = path.parent().unwrap_or_else(|| Path::new(""));
    let absolute = |path: &mut Option<PathBuf>| *path = path.take().map(|path| dir.join(path));
    file.clusters.iter_mut().for_each(|c| absolute(&mut c.cluster.certificate_authority));
    for user in &mut file.users {
        absolute(&mut user.user.client_certificate);
        absolute(&mut user.user.client_key);
    }
    Ok(file)
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, KubeconfigError> {
    std::fs::read(path).map_err(|source| KubeconfigError::Read { path: path.to_owned(), source })
}

fn merge(mut first: File, next: File) -> File {
    if first.current_context.is_empty() {
        first.current_context = next.current_context;
    }
    first.clusters.extend(next.clusters);
    first.users.extend(next.users);
    first.contexts.extend(next.contexts);
    first
}

fn target(file: File) -> Result<Target, KubeconfigError> {
    let missing = |kind: &str, name: &str| KubeconfigError::Missing(format!("{kind} {name:?}"));
    let current = file.current_context;
    let context = file.contexts.into_iter().find(|c| c.name == current);
    let context = context.ok_or_else(|| missing("context", &current))?.context;
    let cluster = file.clusters.into_iter().find(|c| c.name == context.cluster);
    let cluster = cluster.ok_or_else(|| missing("cluster", &context.cluster))?.cluster;
    let user = file.users.into_iter().find(|u| u.name == context.user);
    let user = user.ok_or_else(|| missing("user", &context.user))?.user;
    Ok(Target {
        address: address(&cluster.server)?,
        namespace: context.namespace,
        ca: data(
            "certificate-authority",
            cluster.certificate_authority_data,
            cluster.certificate_authority,
        )?,
        authorization: user.token.as_deref().map(authorization).transpose()?,
        pair: pair(user)?,
    })
}

fn authorization(token: &str) -> Result<Authorization, KubeconfigError> {
    let value = format!("Bearer {}", token.trim());
    let mut value = Authorization::try_from(value).map_err(|_| KubeconfigError::Token)?;
    value.set_sensitive(true);
    Ok(value)
}

/// Certificate and key. Who has a token needs none.
fn pair(user: User) -> Result<Option<Pair>, KubeconfigError> {
    let none = user.client_certificate_data.is_none() && user.client_certificate.is_none();
    if none && user.token.is_some() {
        return Ok(None);
    }
    let certificate =
        data("client-certificate", user.client_certificate_data, user.client_certificate)?;
    Ok(Some((certificate, data("client-key", user.client_key_data, user.client_key)?)))
}

fn data(
    what: &'static str,
    inline: Option<String>,
    path: Option<PathBuf>,
) -> Result<Vec<u8>, KubeconfigError> {
    match (inline, path) {
        (Some(text), _) => STANDARD.decode(text.trim()).map_err(|_| KubeconfigError::Base64(what)),
        (None, Some(path)) => read_bytes(&path),
        (None, None) => Err(KubeconfigError::Missing(what.to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_named_file_wins_then_muster_config_then_kubeconfig_then_home() {
        let from = |named: Option<&str>, env: &[(&str, &str)]| {
            let find =
                |name: &str| env.iter().find(|(n, _)| *n == name).map(|(_, v)| OsString::from(v));
            files_from(named.map(Path::new), find, Some(PathBuf::from("/home/u")))
        };
        let env = [("MUSTER_CONFIG", "/m"), ("KUBECONFIG", "/k1:/k2")];
        assert_eq!(from(Some("/f"), &env), [Path::new("/f")]);
        assert_eq!(from(None, &env), [Path::new("/m")]);
        assert_eq!(from(None, &env[1..]), [Path::new("/k1"), Path::new("/k2")]);
        assert_eq!(from(None, &[("MUSTER_CONFIG", "")]), [Path::new("/home/u/.muster/config")]);
    }

    #[test]
    fn the_current_contexts_parts_are_taken_from_where_they_are() {
        let dir = tempfile::tempdir().expect("a directory");
        std::fs::write(dir.path().join("ca.pem"), "the CA").expect("written");
        let text = format!(
            "apiVersion: v1
kind: Config
clusters: [{{name: hall, cluster: {{server: 'https://[::1]:1/', certificate-authority: ca.pem}}}}]
users: [{{name: u, user: {{client-certificate-data: {c}, client-key-data: {k}}}}}]
contexts: [{{name: hall, context: {{cluster: hall, user: u, namespace: team}}}}]
",
            c = STANDARD.encode("the certificate"),
            k = STANDARD.encode("the key"),
        );
        let (first, second) = (dir.path().join("first"), dir.path().join("second"));
        std::fs::write(&first, "current-context: hall").expect("written");
        std::fs::write(&second, text).expect("written");
        let files = [first, dir.path().join("none"), second];
        let target = load(&files).expect("usable");
        assert_eq!(target.address.to_string(), "[::1]:1");
        assert_eq!(target.namespace.as_deref(), Some("team"));
        let (certificate, key) = target.pair.expect("both");
        assert_eq!((&*target.ca, &*certificate), (&b"the CA"[..], &b"the certificate"[..]));
        assert_eq!(key, b"the key");
        assert!(target.authorization.is_none());
        let error = load(&files[..1]).err().expect("there is no context");
        assert_eq!(error.to_string(), r#"the kubeconfig has no context "hall""#);
        assert!(matches!(load(&files[1..2]), Err(KubeconfigError::Read { .. })));
    }

    #[test]
    fn a_token_stands_for_a_certificate() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("config");
        let load_with = |user: &str| {
            let text = format!(
                "clusters: [{{name: c, cluster: {{server: 'https://h', certificate-authority-data: Y2E=}}}}]
users: [{{name: u, user: {{{user}}}}}]
contexts: [{{name: x, context: {{cluster: c, user: u}}}}]
current-context: x
"
            );
            std::fs::write(&path, text).expect("written");
            load(std::slice::from_ref(&path))
        };
        let target = load_with("token: musteru1.ab.cd").expect("good");
        assert!(!target.has_certificate());
        let request = authorized((), target.authorization.as_ref());
        assert_eq!(request.metadata().get("authorization").expect("sent"), "Bearer musteru1.ab.cd");
        assert!(!format!("{request:?}").contains("musteru1"), "tokens do not get into logs");
        assert!(matches!(load_with("token: \"a\\nb\""), Err(KubeconfigError::Token)));
        assert!(matches!(load_with(""), Err(KubeconfigError::Missing(_))));
    }

    #[test]
    fn addresses() {
        assert_eq!(address("https://host").expect("good").to_string(), "host:7443");
        for bad in ["host:1", "http://host:1", "https://host:1/x", ""] {
            assert!(address(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn hostile_files_are_targets_or_errors() {
        let dir = tempfile::tempdir().expect("a directory");
        let file = [dir.path().join("config")];
        let inputs = muster_hostile::inputs("kubeconfig");
        muster_hostile::feed(bolero::check!(), inputs, |bytes| {
            std::fs::write(&file[0], bytes).expect("it is ours");
            if let Err(error) = load(&file) {
                assert!(!error.to_string().is_empty());
            }
        });
    }
}
