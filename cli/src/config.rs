//! Which controller is asked, and as whom: the kubeconfig.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::Duration;

use kube::config::{KubeConfigOptions, Kubeconfig, KubeconfigError};

/// A connection to a controller in the same building is up in milliseconds; over a bad radio link in
/// seconds. After this it is down, and people should hear of it.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(8);

/// Why there is no controller to ask.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ConfigError {
    /// Nothing is configured and the default file is not there.
    #[error("there is no kubeconfig: {} does not exist", default.display())]
    None { default: PathBuf },
    /// A file was named that cannot be used.
    #[error("the kubeconfig from {origin} cannot be used")]
    Unusable { origin: String, source: KubeconfigError },
    /// A client cannot be made of it.
    #[error("no client can be made from the kubeconfig from {origin}")]
    Client { origin: String, source: kube::Error },
}

impl ConfigError {
    pub(crate) fn hint(&self) -> String {
        match self {
            ConfigError::None { default } => format!(
                "a controller writes {} when it starts: `muster controller`; or name a file with --kubeconfig or MUSTER_CONFIG",
                default.display()
            ),
            ConfigError::Unusable { .. } | ConfigError::Client { .. } => {
                "copy the kubeconfig that the controller wrote, or name another with --kubeconfig"
                    .to_owned()
            }
        }
    }
}

/// Where a kubeconfig was looked for, first to last: flag, `MUSTER_CONFIG`, `KUBECONFIG`, `~/.muster/config`.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Source {
    /// Files to merge; the first one wins where they differ.
    files: Vec<PathBuf>,
    /// For messages: `MUSTER_CONFIG (/path)`.
    pub(crate) origin: String,
    is_default: bool,
}

/// Finds which file is meant. `env` gives environment variables.
pub(crate) fn source(
    flag: Option<&Path>,
    env: impl Fn(&str) -> Option<OsString>,
    home: Option<PathBuf>,
) -> Source {
    if let Some(path) = flag {
        return Source {
            files: vec![path.to_owned()],
            origin: path.display().to_string(),
            is_default: false,
        };
    }
    for variable in ["MUSTER_CONFIG", "KUBECONFIG"] {
        let Some(value) = env(variable) else { continue };
        let files: Vec<PathBuf> =
            std::env::split_paths(&value).filter(|p| !p.as_os_str().is_empty()).collect();
        if !files.is_empty() {
            let origin = format!("{variable} ({})", value.to_string_lossy());
            return Source { files, origin, is_default: false };
        }
    }
    let path = home.unwrap_or_else(|| PathBuf::from(".")).join(".muster").join("config");
    let origin = path.display().to_string();
    Source { files: vec![path], origin, is_default: true }
}

/// A kubeconfig, read.
#[derive(Debug)]
pub(crate) struct Target {
    pub(crate) config: kube::Config,
    /// The controller's URL as the kubeconfig writes it.
    pub(crate) server: String,
    /// Where that is from.
    pub(crate) origin: String,
}

/// Reads the kubeconfig.
pub(crate) async fn load(source: Source, context: Option<&str>) -> Result<Target, ConfigError> {
    let Source { files, origin, is_default } = source;
    if is_default && !files[0].exists() {
        return Err(ConfigError::None { default: files[0].clone() });
    }
    let unusable = |source| ConfigError::Unusable { origin: origin.clone(), source };
    // As kubectl does with KUBECONFIG: a list may name files that are not there, a single file must be.
    let several = files.len() > 1;
    let mut merged: Option<Kubeconfig> = None;
    for file in files.iter().filter(|file| !several || file.exists()) {
        let read = Kubeconfig::read_from(file).map_err(unusable)?;
        merged = Some(match merged {
            None => read,
            Some(before) => before.merge(read).map_err(unusable)?,
        });
    }
    let options = KubeConfigOptions { context: context.map(str::to_owned), ..Default::default() };
    let mut config = kube::Config::from_custom_kubeconfig(merged.unwrap_or_default(), &options)
        .await
        .map_err(unusable)?;
    config.connect_timeout = Some(CONNECT_TIMEOUT);
    let server = config.cluster_url.to_string().trim_end_matches('/').to_owned();
    Ok(Target { config, server, origin })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn from(flag: Option<&str>, env: &[(&str, &str)]) -> Source {
        let find =
            |name: &str| env.iter().find(|(n, _)| *n == name).map(|(_, v)| OsString::from(v));
        source(flag.map(Path::new), find, Some(PathBuf::from("/home/u")))
    }

    #[test]
    fn the_flag_wins_then_muster_config_then_kubeconfig_then_home() {
        let env = [("MUSTER_CONFIG", "/m"), ("KUBECONFIG", "/k1:/k2")];
        assert_eq!(from(Some("/f"), &env).files, [Path::new("/f")]);
        assert_eq!(from(None, &env).origin, "MUSTER_CONFIG (/m)");
        assert_eq!(from(None, &env[1..]).files, [Path::new("/k1"), Path::new("/k2")]);
        let default = from(None, &[("MUSTER_CONFIG", "")]);
        assert_eq!(default.files, [Path::new("/home/u/.muster/config")]);
        assert!(default.is_default, "an empty variable names nothing");
    }

    #[tokio::test]
    async fn a_missing_default_says_how_to_get_one() {
        let dir = tempfile::tempdir().expect("a directory");
        let error = load(source(None, |_| None, Some(dir.path().to_owned())), None)
            .await
            .expect_err("nothing there");
        assert!(matches!(error, ConfigError::None { .. }), "{error}");
        assert!(error.hint().contains("`muster controller`"));
    }

    #[tokio::test]
    async fn the_server_of_the_chosen_context_is_taken() {
        let dir = tempfile::tempdir().expect("a directory");
        let file = dir.path().join("config");
        let cluster = |name: &str, port: u16| serde_json::json!({"name": name, "cluster": {"server": format!("https://127.0.0.1:{port}")}});
        let context = |name: &str| serde_json::json!({"name": name, "context": {"cluster": name, "user": "u", "namespace": name}});
        let text = serde_json::json!({
            "apiVersion": "v1", "kind": "Config", "current-context": "lab",
            "clusters": [cluster("lab", 1), cluster("hall", 2)],
            "contexts": [context("lab"), context("hall")],
            "users": [{"name": "u", "user": {}}],
        });
        std::fs::write(&file, text.to_string()).expect("written");
        for (context, server, namespace) in
            [(None, "https://127.0.0.1:1", "lab"), (Some("hall"), "https://127.0.0.1:2", "hall")]
        {
            let target = load(source(Some(&file), |_| None, None), context).await.expect("good");
            assert_eq!(
                (target.server.as_str(), &*target.config.default_namespace),
                (server, namespace)
            );
        }
    }
}
