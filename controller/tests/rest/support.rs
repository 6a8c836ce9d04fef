//! A controller for one test, and clients for it.

use std::path::PathBuf;

use http::{Method, Request};
use kube::Client;
use kube::config::{KubeConfigOptions, Kubeconfig};
use muster_controller::app::{self, Running};
use muster_controller::config::Config;
use serde_json::{Value, json};
use tempfile::TempDir;

pub(crate) const G: &str = "/apis/muster.dev/v1alpha1";
pub(crate) const TASKS: &str = "/apis/muster.dev/v1alpha1/namespaces/default/tasks";
pub(crate) const EVENTS: &str = "/api/v1/namespaces/default/events";

/// No wait in a test should take this long; a machine under load may need a good part of it.
pub(crate) const DEADLINE: std::time::Duration = std::time::Duration::from_secs(60);

pub(crate) struct Cluster {
    pub(crate) running: Running,
    pub(crate) dir: TempDir,
}

impl Cluster {
    pub(crate) async fn start() -> Self {
        Self::start_with(|_| {}).await
    }

    /// With other settings than every test's.
    pub(crate) async fn start_with(change: impl FnOnce(&mut Config)) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut config = config(&dir);
        change(&mut config);
        let running = app::start(config).await.unwrap();
        Self { running, dir }
    }

    pub(crate) async fn restart(self) -> Self {
        let Self { running, dir } = self;
        running.shut_down().await.unwrap();
        let running = app::start(config(&dir)).await.unwrap();
        Self { running, dir }
    }

    /// Waits until the object at `path` is as wanted, woken by the store's changes.
    pub(crate) async fn until(&self, path: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        let (store, admin) = (&self.running.context().store, self.admin().await);
        let mut last = Value::Null;
        let waited = tokio::time::timeout(DEADLINE, async {
            loop {
                let mut changes = store.watch_all(store.revision()).unwrap();
                last = get(&admin, path).await.1;
                if wanted(&last) {
                    return;
                }
                changes.next().await.unwrap();
            }
        });
        assert!(waited.await.is_ok(), "{path} is still {last}");
        last
    }

    pub(crate) fn kubeconfig(&self) -> PathBuf {
        self.dir.path().join("kubeconfig")
    }

    async fn config(&self) -> kube::Config {
        // Only the first caller of a process installs it, and any of them is as good.
        drop(rustls::crypto::ring::default_provider().install_default());
        let file = Kubeconfig::read_from(self.kubeconfig()).unwrap();
        let options = KubeConfigOptions::default();
        let mut config = kube::Config::from_custom_kubeconfig(file, &options).await.unwrap();
        // Refusals are what these tests are after.
        config.default_retry = false;
        config
    }

    pub(crate) async fn admin(&self) -> Client {
        Client::try_from(self.config().await).unwrap()
    }

    pub(crate) async fn anonymous(&self) -> Client {
        let mut config = self.config().await;
        config.auth_info = kube::config::AuthInfo::default();
        Client::try_from(config).unwrap()
    }

    /// A token of this user, who is in the group `lab` by it.
    pub(crate) async fn token(&self, user: &str, seconds: u64) -> Value {
        let spec = json!({"spec": {"user": user, "groups": ["lab"], "ttlSeconds": seconds}});
        let admin = self.admin().await;
        let (code, made) = send(&admin, "POST", &format!("{G}/usertokens"), spec).await;
        assert_eq!(code, 201, "{made}");
        made
    }

    /// A client with a token of this user.
    pub(crate) async fn user(&self, user: &str) -> Client {
        let made = self.token(user, 3600).await;
        self.bearer(made["status"]["token"].as_str().unwrap()).await
    }

    /// Gives a user a role in these namespaces, or with null in the whole cluster, by an Access of their name.
    pub(crate) async fn give(&self, user: &str, role: &str, namespaces: Value) {
        let access = json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Access", "metadata": {"name": user},
            "spec": {"role": role, "namespaces": namespaces, "subjects": [{"kind": "User", "name": user}]},
        });
        let admin = self.admin().await;
        let (code, answer) = send(&admin, "POST", &format!("{G}/accesses"), access).await;
        assert_eq!(code, 201, "{answer}");
    }

    /// A client that shows this token.
    pub(crate) async fn bearer(&self, token: &str) -> Client {
        let mut config = self.config().await;
        config.auth_info = serde_json::from_value(json!({ "token": token })).unwrap();
        Client::try_from(config).unwrap()
    }

    /// A client with the certificate of a node's agent, which joins.
    pub(crate) async fn agent(&self, node: &str) -> Client {
        let admin = self.admin().await;
        let (_, made) = send(&admin, "POST", &format!("{G}/jointokens"), Value::Null).await;
        let key = rcgen::KeyPair::generate().unwrap();
        let csr = rcgen::CertificateParams::default().serialize_request(&key).unwrap();
        let ask = json!({"token": made["status"]["token"], "nodeName": node, "kind": "Robot",
            "csr": csr.pem().unwrap()});
        let (code, joined) = send(&self.anonymous().await, "POST", &format!("{G}/join"), ask).await;
        assert_eq!(code, 200, "{joined}");
        let certificate = joined["certificate"].as_str().unwrap();
        self.holder(certificate, &key.serialize_pem()).await
    }

    /// A client with a certificate of its own.
    pub(crate) async fn holder(&self, certificate: &str, key: &str) -> Client {
        use base64::Engine as _;
        let encode = |text: &str| base64::engine::general_purpose::STANDARD.encode(text);
        let mut config = self.config().await;
        let key: kube::config::AuthInfo = serde_json::from_value(json!({
            "client-certificate-data": encode(certificate),
            "client-key-data": encode(key),
        }))
        .unwrap();
        config.auth_info = key;
        Client::try_from(config).unwrap()
    }
}

fn config(dir: &TempDir) -> Config {
    Config {
        data_dir: dir.path().join("data"),
        listen: "127.0.0.1:0".parse().unwrap(),
        kubeconfig: dir.path().join("kubeconfig"),
        kubeconfig_asked: true,
        advertise: Vec::new(),
        encryption_key: None,
        certificate_ttl: muster_controller::pki::TTL,
        requests_per_second: muster_controller::config::REQUESTS_PER_SECOND,
    }
}

/// Sends a request and gives back the code and the JSON.
pub(crate) async fn send(client: &Client, method: &str, path: &str, body: Value) -> (u16, Value) {
    let media = if method == "PATCH" { "application/merge-patch+json" } else { "application/json" };
    send_as(client, method, path, media, body.to_string()).await
}

pub(crate) async fn send_as(
    client: &Client,
    method: &str,
    path: &str,
    media: &str,
    body: String,
) -> (u16, Value) {
    let method: Method = method.parse().unwrap();
    let body = if method == Method::GET { String::new() } else { body };
    let request = Request::builder()
        .method(method)
        .uri(path)
        .header("content-type", media)
        .body(kube::client::Body::from(body.into_bytes()))
        .unwrap();
    let response = client.send(request).await.unwrap();
    let code = response.status().as_u16();
    let bytes = response.into_body().collect_bytes().await.unwrap();
    let value = serde_json::from_slice(&bytes)
        .unwrap_or_else(|_| Value::String(String::from_utf8_lossy(&bytes).into_owned()));
    (code, value)
}

pub(crate) async fn get(client: &Client, path: &str) -> (u16, Value) {
    send(client, "GET", path, Value::Null).await
}

/// A task that is good.
pub(crate) fn task(name: &str) -> Value {
    json!({
        "apiVersion": "muster.dev/v1alpha1",
        "kind": "Task",
        "metadata": {"name": name, "labels": {"app": name}},
        "spec": {"run": {"process": {"command": ["/bin/true"]}}},
    })
}

/// An object that nothing in the controller works on, for tests of the conventions alone.
pub(crate) fn event(name: &str) -> Value {
    json!({
        "apiVersion": "v1",
        "kind": "Event",
        "metadata": {"name": name, "labels": {"app": name}},
        "involvedObject": {},
        "reason": "Tested",
        "type": "Normal",
    })
}

/// Registers the robot `name`, which never connects.
pub(crate) async fn register(client: &Client, name: &str) {
    let node = json!({
        "apiVersion": "muster.dev/v1alpha1",
        "kind": "Node",
        "metadata": {"name": name},
        "spec": {"kind": "Robot"},
    });
    let (code, answer) = send(client, "POST", &format!("{G}/nodes"), node).await;
    assert_eq!(code, 201, "{answer}");
}

/// The fields of a Status that tests look at.
pub(crate) fn refusal((code, status): &(u16, Value)) -> (u16, &str) {
    assert_eq!(status["kind"], "Status", "{status}");
    (*code, status["reason"].as_str().unwrap())
}

pub(crate) fn names(list: &Value) -> Vec<&str> {
    let items = list["items"].as_array().unwrap();
    items.iter().map(|item| item["metadata"]["name"].as_str().unwrap()).collect()
}
