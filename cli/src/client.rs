//! REST of the controller, in objects as JSON. Every failure leaves as a [`CliError`] of its class.

use bytes::Bytes;
use http::{Method, Request, Response, StatusCode, header};
use http_body_util::BodyExt as _;
use kube::client::Body;
use kube::core::Status;
use muster_api::kind::KindInfo;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::config::{ConfigError, Target};
use crate::error::{CliError, Refusal, chain};

/// Objects a list request asks for at once; the rest is fetched by further requests.
const PAGE: &str = "500";
/// Who made a change, as `metadata.managedFields` may name it.
const FIELD_MANAGER: (&str, &str) = ("fieldManager", "muster");

/// A client of one controller.
#[derive(Clone)]
pub(crate) struct Client {
    http: kube::Client,
    /// Its URL.
    pub(crate) server: String,
    /// Where the URL is from, for messages.
    pub(crate) origin: String,
}

/// Messages in both directions.
pub(crate) type Socket =
    tokio_tungstenite::WebSocketStream<hyper_util::rt::TokioIo<hyper::upgrade::Upgraded>>;

/// Which objects of a collection are meant.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Selection {
    /// Label selector.
    pub(crate) labels: Option<String>,
    /// Field selector.
    pub(crate) fields: Option<String>,
}

/// A list and the revision it is of.
#[derive(Debug)]
pub(crate) struct List {
    pub(crate) items: Vec<Value>,
    pub(crate) revision: String,
}

/// Whether a write is stored or only checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mode {
    Store,
    DryRun,
}

/// How an object is deleted.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Deletion<'a> {
    /// Seconds between asking a task to end and killing it; none: its own.
    pub(crate) grace: Option<u32>,
    /// Only this one, not a later one of the same name.
    pub(crate) uid: Option<&'a str>,
    /// What becomes of what it owns: Background, Foreground, Orphan.
    pub(crate) propagation: Option<&'a str>,
}

impl Selection {
    /// One object by name.
    pub(crate) fn name(name: &str) -> Self {
        Selection { labels: None, fields: Some(format!("metadata.name={name}")) }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.labels.is_none() && self.fields.is_none()
    }

    pub(crate) fn pairs(&self) -> Vec<(&str, &str)> {
        let labels = self.labels.as_deref().map(|l| ("labelSelector", l));
        let fields = self.fields.as_deref().map(|f| ("fieldSelector", f));
        labels.into_iter().chain(fields).collect()
    }
}

/// The path of an object or a collection. `namespace: None` of a namespaced kind: all namespaces.
pub(crate) fn path(info: &KindInfo, namespace: Option<&str>, name: Option<&str>) -> String {
    let mut path = if info.group.is_empty() {
        format!("/api/{}", info.version)
    } else {
        format!("/apis/{}/{}", info.group, info.version)
    };
    if let Some(namespace) = namespace.filter(|_| info.namespaced) {
        path.push_str(&format!("/namespaces/{}", segment(namespace)));
    }
    path.push_str(&format!("/{}", info.plural));
    if let Some(name) = name {
        path.push_str(&format!("/{}", segment(name)));
    }
    path
}

/// The path of something of the group that is no object, `usage`.
pub(crate) fn group_path(rest: &str) -> String {
    format!("/apis/{}/{rest}", muster_api::API_VERSION)
}

/// The path with parameters.
pub(crate) fn with_query(path: &str, pairs: &[(&str, &str)]) -> String {
    if pairs.is_empty() {
        return path.to_owned();
    }
    let query = form_urlencoded::Serializer::new(String::new()).extend_pairs(pairs).finish();
    format!("{path}?{query}")
}

/// One segment of a path.
pub(crate) fn segment(text: &str) -> String {
    form_urlencoded::byte_serialize(text.as_bytes()).collect::<String>().replace('+', "%20")
}

impl Client {
    /// A client of the controller that a kubeconfig names.
    pub(crate) fn new(target: Target) -> Result<Self, ConfigError> {
        let Target { config, server, origin } = target;
        match kube::Client::try_from(config) {
            Ok(http) => Ok(Client { http, server, origin }),
            Err(source) => Err(ConfigError::Client { origin, source }),
        }
    }

    /// A client of a service in this process; for tests.
    #[cfg(test)]
    pub(crate) fn of_service(http: kube::Client) -> Self {
        Client { http, server: "https://fake:7443".to_owned(), origin: "a test".to_owned() }
    }

    /// The namespace that the kubeconfig chooses.
    pub(crate) fn default_namespace(&self) -> &str {
        self.http.default_namespace()
    }

    /// One object.
    pub(crate) async fn get(
        &self,
        info: &KindInfo,
        namespace: Option<&str>,
        name: &str,
    ) -> Result<Value, CliError> {
        self.get_json(&path(info, namespace, Some(name))).await
    }

    /// One object, when it exists.
    pub(crate) async fn find(
        &self,
        info: &KindInfo,
        namespace: Option<&str>,
        name: &str,
    ) -> Result<Option<Value>, CliError> {
        match self.get(info, namespace, name).await {
            Ok(object) => Ok(Some(object)),
            Err(error) if error.is_not_found() => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Every object of a collection that is selected.
    pub(crate) async fn list(
        &self,
        info: &KindInfo,
        namespace: Option<&str>,
        selection: &Selection,
    ) -> Result<List, CliError> {
        let path = path(info, namespace, None);
        let mut list = List { items: Vec::new(), revision: String::new() };
        let mut next: Option<String> = None;
        loop {
            let mut pairs = selection.pairs();
            pairs.push(("limit", PAGE));
            if let Some(next) = &next {
                pairs.push(("continue", next));
            }
            let mut page = self.get_json::<Value>(&with_query(&path, &pairs)).await?;
            let text =
                |field: &str| page.pointer(field).and_then(Value::as_str).unwrap_or_default();
            list.revision = text("/metadata/resourceVersion").to_owned();
            next = Some(text("/metadata/continue").to_owned()).filter(|c| !c.is_empty());
            if let Some(Value::Array(items)) = page.get_mut("items").map(Value::take) {
                list.items.extend(items.into_iter().map(|item| with_kind(item, info)));
            }
            if next.is_none() {
                return Ok(list);
            }
        }
    }

    /// Creates an object.
    pub(crate) async fn create(
        &self,
        info: &KindInfo,
        namespace: Option<&str>,
        object: &Value,
        mode: Mode,
    ) -> Result<Value, CliError> {
        let uri = with_query(&path(info, namespace, None), &write_pairs(mode));
        self.call(Method::POST, &uri, Some(("application/json", object))).await
    }

    /// Applies a JSON merge patch.
    pub(crate) async fn patch(
        &self,
        info: &KindInfo,
        namespace: Option<&str>,
        name: &str,
        patch: &Value,
        mode: Mode,
    ) -> Result<Value, CliError> {
        let uri = with_query(&path(info, namespace, Some(name)), &write_pairs(mode));
        self.call(Method::PATCH, &uri, Some(("application/merge-patch+json", patch))).await
    }

    /// Applies a JSON merge patch to any path.
    pub(crate) async fn patch_path(&self, uri: &str, patch: &Value) -> Result<Value, CliError> {
        let uri = with_query(uri, &write_pairs(Mode::Store));
        self.call(Method::PATCH, &uri, Some(("application/merge-patch+json", patch))).await
    }

    /// Deletes an object.
    pub(crate) async fn delete(
        &self,
        info: &KindInfo,
        namespace: Option<&str>,
        name: &str,
        how: Deletion<'_>,
    ) -> Result<Value, CliError> {
        let mut options = json!({"apiVersion": "v1", "kind": "DeleteOptions"});
        if let Some(grace) = how.grace {
            options["gracePeriodSeconds"] = grace.into();
        }
        if let Some(uid) = how.uid {
            options["preconditions"] = json!({"uid": uid});
        }
        if let Some(policy) = how.propagation {
            options["propagationPolicy"] = policy.into();
        }
        let uri = path(info, namespace, Some(name));
        self.call(Method::DELETE, &uri, Some(("application/json", &options))).await
    }

    /// GET of any path.
    pub(crate) async fn get_json<T: DeserializeOwned>(&self, uri: &str) -> Result<T, CliError> {
        self.call(Method::GET, uri, None).await
    }

    /// POST to any path.
    pub(crate) async fn post_json<T: DeserializeOwned>(
        &self,
        uri: &str,
        body: &Value,
    ) -> Result<T, CliError> {
        self.call(Method::POST, uri, Some(("application/json", body))).await
    }

    /// DELETE of any path.
    pub(crate) async fn delete_path(&self, uri: &str) -> Result<(), CliError> {
        let response = self.send(Method::DELETE, uri, None).await?;
        self.collect(response).await.map(drop)
    }

    /// GET of a body that goes on.
    pub(crate) async fn stream(&self, uri: &str) -> Result<Stream, CliError> {
        let response = self.send(Method::GET, uri, None).await?;
        Ok(Stream { client: self.clone(), body: response.into_body(), rest: Vec::new() })
    }

    /// GET that becomes a WebSocket, of the subprotocol `v5.channel.k8s.io`.
    pub(crate) async fn connect(&self, uri: &str) -> Result<Socket, CliError> {
        let request = Request::get(uri)
            .body(Vec::new())
            .map_err(|error| CliError::usage(format!("{uri:?} is not a path: {error}")))?;
        match self.http.connect(request).await {
            Ok(connection) => Ok(connection.into_stream()),
            Err(kube::Error::Api(status)) => Err(self.refused(*status)),
            Err(error) => Err(self.unreachable(error)),
        }
    }

    async fn call<T: DeserializeOwned>(
        &self,
        method: Method,
        uri: &str,
        body: Option<(&str, &Value)>,
    ) -> Result<T, CliError> {
        let request = format!("{method} {uri}");
        let response = self.send(method, uri, body).await?;
        let bytes = self.collect(response).await?;
        serde_json::from_slice(&bytes).map_err(|source| CliError::Answer {
            server: self.server.clone(),
            request,
            source,
        })
    }

    /// Sends a request; an answer that says no is an error already.
    async fn send(
        &self,
        method: Method,
        uri: &str,
        body: Option<(&str, &Value)>,
    ) -> Result<Response<Body>, CliError> {
        let mut request = Request::builder().method(method).uri(uri);
        let mut bytes = Vec::new();
        if let Some((content_type, value)) = body {
            request = request.header(header::CONTENT_TYPE, content_type);
            bytes = value.to_string().into_bytes();
        }
        let request = request
            .header(header::ACCEPT, "application/json, */*")
            .body(Body::from(bytes))
            .map_err(|error| CliError::usage(format!("{uri:?} is not a path: {error}")))?;
        let response = self.http.send(request).await.map_err(|e| self.unreachable(e))?;
        let code = response.status();
        if code.is_success() {
            return Ok(response);
        }
        let bytes = self.collect(response).await?;
        Err(CliError::Refused(Box::new(self.refusal(code, &bytes))))
    }

    fn refusal(&self, code: StatusCode, body: &[u8]) -> Refusal {
        let mut status = serde_json::from_slice::<Status>(body)
            .ok()
            .filter(|status| !status.message.is_empty())
            .unwrap_or_else(|| Status::failure(&plain_message(code, body), ""));
        status.code = code.as_u16();
        Refusal::of_status(status, &self.server, &self.origin)
    }

    /// A refusal that came inside a stream.
    pub(crate) fn refused(&self, status: Status) -> CliError {
        CliError::Refused(Box::new(Refusal::of_status(status, &self.server, &self.origin)))
    }

    async fn collect(&self, response: Response<Body>) -> Result<Bytes, CliError> {
        let body = response.into_body().collect().await.map_err(|e| self.unreachable(e))?;
        Ok(body.to_bytes())
    }

    fn unreachable(&self, error: kube::Error) -> CliError {
        // kube's own texts name layers of its client; what people need is beneath them.
        let source: Box<dyn std::error::Error + Send + Sync> = match error {
            kube::Error::Service(source) => Box::new(Unanswered(innermost(source.as_ref()))),
            other => Box::new(Unanswered(chain(&other))),
        };
        CliError::Unreachable { server: self.server.clone(), origin: self.origin.clone(), source }
    }
}

/// Why there was no answer.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Unanswered(String);

fn innermost(error: &(dyn std::error::Error + 'static)) -> String {
    let mut last = error;
    while let Some(next) = last.source() {
        last = next;
    }
    last.to_string()
}

fn plain_message(code: StatusCode, body: &[u8]) -> String {
    let text = String::from_utf8_lossy(body);
    let text = text.trim();
    if text.is_empty() {
        return format!("the controller answered {code}");
    }
    format!("the controller answered {code}: {}", text.chars().take(200).collect::<String>())
}

fn write_pairs(mode: Mode) -> Vec<(&'static str, &'static str)> {
    let mut pairs = vec![FIELD_MANAGER];
    if mode == Mode::DryRun {
        pairs.push(("dryRun", "All"));
    }
    pairs
}

/// Items of a list may leave out what the list says of all of them.
pub(crate) fn with_kind(mut object: Value, info: &KindInfo) -> Value {
    if let Some(members) = object.as_object_mut() {
        members.entry("apiVersion").or_insert_with(|| info.api_version().into());
        members.entry("kind").or_insert_with(|| info.kind.into());
    }
    object
}

/// A body that goes on.
pub(crate) struct Stream {
    client: Client,
    body: Body,
    /// The beginning of a line whose end has not come yet.
    rest: Vec<u8>,
}

impl Stream {
    /// The next piece; none: the controller ended it. Cancel-safe: a piece is whole or not taken.
    pub(crate) async fn next_bytes(&mut self) -> Result<Option<Bytes>, CliError> {
        while let Some(frame) = self.body.frame().await {
            let frame = frame.map_err(|e| self.client.unreachable(e))?;
            if let Ok(data) = frame.into_data() {
                return Ok(Some(data));
            }
        }
        Ok(None)
    }

    /// The next line, without its end; a line that was cut off is dropped. Cancel-safe: what is
    /// there of a line stays for the next call.
    pub(crate) async fn next_line(&mut self) -> Result<Option<Vec<u8>>, CliError> {
        loop {
            if let Some(end) = self.rest.iter().position(|b| *b == b'\n') {
                let tail = self.rest.split_off(end + 1);
                let mut line = std::mem::replace(&mut self.rest, tail);
                line.pop();
                return Ok(Some(line));
            }
            match self.next_bytes().await? {
                Some(bytes) => self.rest.extend_from_slice(&bytes),
                None => return Ok(None),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use muster_api::kind::find_by_word;

    use super::*;

    #[test]
    fn paths_are_those_of_kubernetes() {
        let task = find_by_word("task").expect("served");
        let node = find_by_word("node").expect("served");
        let event = find_by_word("event").expect("served");
        let g = "/apis/muster.dev/v1alpha1";
        assert_eq!(path(task, Some("lab"), Some("x")), format!("{g}/namespaces/lab/tasks/x"));
        assert_eq!(path(task, None, None), format!("{g}/tasks"));
        assert_eq!(path(node, Some("lab"), Some("r.1")), format!("{g}/nodes/r.1"));
        assert_eq!(path(event, Some("lab"), None), "/api/v1/namespaces/lab/events");
        assert_eq!(
            path(task, Some("a"), Some("../b c")),
            format!("{g}/namespaces/a/tasks/..%2Fb%20c")
        );
    }

    #[test]
    fn parameters_are_encoded() {
        let pairs = [("labelSelector", "a in (b,c)"), ("limit", "5")];
        assert_eq!(with_query("/p", &pairs), "/p?labelSelector=a+in+%28b%2Cc%29&limit=5");
        assert_eq!(with_query("/p", &[]), "/p");
    }
}
