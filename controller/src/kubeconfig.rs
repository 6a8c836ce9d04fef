//! The admin's kubeconfig, as `muster` and stock `kubectl` read it.

use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use crate::pki::{Pem, PkiError, write_private};

/// `https://host:port`, with brackets around an IPv6 address.
pub(crate) fn url(host: &str, port: u16) -> String {
    if host.contains(':') {
        format!("https://[{host}]:{port}")
    } else {
        format!("https://{host}:{port}")
    }
}

/// Writes the file whole or not at all, readable by its owner only. A file that already says this is left alone.
pub(crate) fn write(path: &Path, server: &str, ca: &str, admin: &Pem) -> Result<(), PkiError> {
    let text = render(server, ca, admin);
    if std::fs::read_to_string(path).is_ok_and(|present| present == text) {
        return Ok(());
    }
    write_private(path, text.as_bytes())
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
