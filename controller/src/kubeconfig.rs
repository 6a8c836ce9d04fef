//! The admin's kubeconfig, as `muster` and stock `kubectl` read it.

use std::io;
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use muster_failpoint::{Failpoint, Step, reach};

use crate::pki::{Pem, PkiError, write_private};

/// `https://host:port`, with brackets around an IPv6 address.
pub(crate) fn url(host: &str, port: u16) -> String {
    if host.contains(':') {
        format!("https://[{host}]:{port}")
    } else {
        format!("https://{host}:{port}")
    }
}

/// Why the admin's kubeconfig is not written.
#[derive(Debug, thiserror::Error)]
pub enum KubeconfigError {
    /// It may be the only copy of somebody's credential.
    #[error(
        "{} belongs to another cluster{}; give this controller its own file with --kubeconfig FILE, or move that one away",
        path.display(),
        server.as_ref().map(|server| format!(" ({server})")).unwrap_or_default()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What it says to dial, when that can be read.
        server: Option<String>,
    },
    /// It cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// It cannot be written.
    #[error(transparent)]
    Write(#[from] PkiError),
}

/// Writes the file whole or not at all, readable by its owner only. A file that already says this is left alone; one
/// of another cluster too, unless the file was `asked` for by name.
pub(crate) fn write(
    path: &Path,
    asked: bool,
    server: &str,
    ca: &str,
    admin: &Pem,
) -> Result<(), KubeconfigError> {
    let text = render(server, ca, admin);
    match std::fs::read_to_string(path) {
        Ok(present) if present == text => return Ok(()),
        // The CA tells clusters apart: ports and addresses change, and two clusters take turns at one.
        Ok(present) if !asked && !present.trim().is_empty() && !mentions(&present, ca) => {
            let server = value_of(&present, "server:").map(str::to_owned);
            return Err(KubeconfigError::Foreign { path: path.to_owned(), server });
        }
        Ok(_) => {}
        Err(source) if source.kind() == io::ErrorKind::NotFound => {}
        // Not text is not ours either, but whoever names the file means it.
        Err(_) if asked => {}
        Err(source) => return Err(KubeconfigError::Read { path: path.to_owned(), source }),
    }
    reach(Failpoint::Kubeconfig, Step::Before);
    write_private(Failpoint::Kubeconfig, path, text.as_bytes())?;
    reach(Failpoint::Kubeconfig, Step::After);
    Ok(())
}

/// Whether the file trusts our CA.
fn mentions(file: &str, ca: &str) -> bool {
    value_of(file, "certificate-authority-data:").is_some_and(|data| data == STANDARD.encode(ca))
}

/// The value behind the first such key. We wrote the file ourselves if it is ours, so a line is enough.
fn value_of<'a>(file: &'a str, key: &str) -> Option<&'a str> {
    file.lines().find_map(|line| line.trim().strip_prefix(key)).map(str::trim)
}

fn render(server: &str, ca: &str, admin: &Pem) -> String {
    format!(
        "apiVersion: v1
kind: Config
clusters:
- name: muster
  cluster:
    server: {server}
    certificate-authority-data: {ca}
users:
- name: muster-admin
  user:
    client-certificate-data: {certificate}
    client-key-data: {key}
contexts:
- name: muster
  context:
    cluster: muster
    user: muster-admin
    namespace: default
current-context: muster
preferences: {{}}
",
        ca = STANDARD.encode(ca),
        certificate = STANDARD.encode(&admin.certificate),
        key = STANDARD.encode(&admin.key),
    )
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn another_clusters_file_is_replaced_only_when_it_was_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("sub/config");
        let admin = Pem { certificate: "c".to_owned(), key: "k".to_owned() };
        let write = |asked, server: &str, ca: &str| write(&path, asked, server, ca, &admin);
        write(false, "https://a:1", "ours").unwrap();
        write(false, "https://a:2", "ours").unwrap();
        let refused = write(false, "https://b:1", "other").unwrap_err().to_string();
        assert!(
            refused.contains("another cluster (https://a:2)") && refused.contains("--kubeconfig"),
            "{refused}"
        );
        assert!(std::fs::read_to_string(&path).unwrap().contains("https://a:2"));
        write(true, "https://b:1", "other").unwrap();
        assert!(std::fs::read_to_string(&path).unwrap().contains("https://b:1"));
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        std::fs::write(&path, "apiVersion: v1\nkind: Config\n").unwrap();
        let refused = write(false, "https://b:1", "other").unwrap_err();
        assert!(matches!(refused, KubeconfigError::Foreign { server: None, .. }), "{refused}");
    }
}
