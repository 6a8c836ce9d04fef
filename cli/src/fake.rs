//! A controller for tests: objects in memory behind the same paths, reached without a socket.
//!
//! It keeps the conventions that the client relies on (revisions, watches that resume, 410 after
//! compaction, dry runs, Status) and decides nothing: tests put in what they need.

use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::response::{IntoResponse as _, Response};
use clap::Parser as _;
use http::{Method, StatusCode, Uri};
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::args::Cli;
use crate::client::Client;
use crate::command;
use crate::error::CliError;
use crate::output::ui::Ui;
use crate::session::Session;

type Edit = Box<dyn Fn(&mut Value) + Send>;

#[derive(Default)]
struct Inner {
    revision: u64,
    /// By `tasks/default/a` or `nodes/r1`.
    objects: BTreeMap<String, Value>,
    history: Vec<(u64, &'static str, String, Value)>,
    compacted: u64,
    held: Vec<String>,
    refused: Vec<(String, String, String)>,
    /// The same, once nobody rehearses any more.
    refused_late: Vec<(String, String, String)>,
    /// So many transactions come too late.
    moves: u32,
    answers: BTreeMap<String, String>,
    requests: Vec<String>,
    last_body: Value,
    on_create: Option<Edit>,
    meanwhile: Option<Edit>,
}

/// The fake. Clones are the same one.
#[derive(Clone)]
pub(crate) struct Fake {
    inner: Arc<Mutex<Inner>>,
    changed: Arc<watch::Sender<u64>>,
}

/// A task that runs `x`, with this status.
pub(crate) fn task(name: &str, status: Value) -> Value {
    json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Task",
        "metadata": {"name": name, "namespace": "default"},
        "spec": {"run": {"process": {"command": ["x"]}}}, "status": status,
    })
}

/// A framework that wants everything, with this status.
pub(crate) fn framework(name: &str, status: Value) -> Value {
    json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Framework",
        "metadata": {"name": name, "namespace": "default", "uid": "u-1"},
        "spec": {}, "status": status,
    })
}

/// A set of three tasks, with this status.
pub(crate) fn taskset(name: &str, status: Value) -> Value {
    json!({
        "apiVersion": muster_api::API_VERSION, "kind": "TaskSet",
        "metadata": {"name": name, "namespace": "default", "generation": 2},
        "spec": {"replicas": 3, "template": {"spec": {"run": {"process": {"command": ["x"]}}}}},
        "status": status,
    })
}

/// A robot with this status.
pub(crate) fn node(name: &str, status: Value) -> Value {
    json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Node",
        "metadata": {"name": name}, "spec": {"kind": "Robot"}, "status": status,
    })
}

/// Standard output that a test reads afterwards.
#[derive(Clone, Default)]
struct Captured(Arc<Mutex<Vec<u8>>>);

impl io::Write for Captured {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Fake {
    pub(crate) fn new() -> Self {
        Fake { inner: Arc::default(), changed: Arc::new(watch::channel(0).0) }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A client of it.
    pub(crate) fn client(&self) -> Client {
        let router = Router::new().fallback(handle).with_state(self.clone());
        Client::of_service(kube::Client::new(router, "default"))
    }

    /// Runs a command line; the exit code and what was printed.
    pub(crate) async fn run(&self, line: &[&str]) -> (u8, String) {
        match self.try_run(line).await {
            Ok(done) => done,
            Err(error) => panic!("{line:?}: {error:?}"),
        }
    }

    /// Runs a command line that may fail.
    pub(crate) async fn try_run(&self, line: &[&str]) -> Result<(u8, String), CliError> {
        let words = ["muster"].iter().chain(line);
        let cli = Cli::try_parse_from(words).map_err(|e| CliError::usage(e.to_string()))?;
        let out = Captured::default();
        let ui = Ui::plain(Box::new(out.clone()));
        let mut session = Session::new(self.client(), ui, cli.global.namespace.as_deref());
        let code = command::dispatch(cli.command, &mut session).await?;
        let bytes = out.0.lock().unwrap_or_else(PoisonError::into_inner).clone();
        Ok((code, String::from_utf8(bytes).expect("text")))
    }

    /// Stores an object, with the metadata that a controller would give it.
    pub(crate) fn put(&self, key: &str, mut object: Value) {
        let mut inner = self.lock();
        inner.revision += 1;
        let revision = inner.revision;
        let metadata = &mut object["metadata"];
        metadata["resourceVersion"] = revision.to_string().into();
        if metadata["uid"].is_null() {
            metadata["uid"] = format!("uid-{revision}").into();
        }
        let event = if inner.objects.contains_key(key) { "MODIFIED" } else { "ADDED" };
        inner.objects.insert(key.to_owned(), object.clone());
        inner.history.push((revision, event, key.to_owned(), object));
        drop(inner);
        self.changed.send_replace(revision);
    }

    /// Changes an object.
    #[track_caller]
    pub(crate) fn edit(&self, key: &str, change: impl FnOnce(&mut Value)) {
        let mut object = self.object(key).expect("an object to edit");
        change(&mut object);
        self.put(key, object);
    }

    /// Removes an object.
    pub(crate) fn remove(&self, key: &str) {
        let mut inner = self.lock();
        let Some(mut object) = inner.objects.remove(key) else { return };
        inner.revision += 1;
        let revision = inner.revision;
        object["metadata"]["resourceVersion"] = revision.to_string().into();
        inner.history.push((revision, "DELETED", key.to_owned(), object));
        drop(inner);
        self.changed.send_replace(revision);
    }

    /// Forgets the history; watches have to list again.
    pub(crate) fn compact(&self) {
        let mut inner = self.lock();
        inner.compacted = inner.revision;
        let revision = inner.revision;
        drop(inner);
        self.changed.send_replace(revision);
    }

    /// A deletion of this object is only a wish.
    pub(crate) fn hold(&self, key: &str) {
        self.lock().held.push(key.to_owned());
    }

    /// Writes to objects of this name are refused because of a field.
    pub(crate) fn refuse(&self, name: &str, field: &str, message: &str) {
        self.lock().refused.push((name.to_owned(), field.to_owned(), message.to_owned()));
    }

    /// The same, but for dry runs: somebody else was faster.
    pub(crate) fn refuse_late(&self, name: &str, field: &str, message: &str) {
        self.lock().refused_late.push((name.to_owned(), field.to_owned(), message.to_owned()));
    }

    /// The next transactions find that the cluster has moved on.
    pub(crate) fn move_on(&self, times: u32) {
        self.lock().moves = times;
    }

    /// Answers `METHOD PATH`.
    pub(crate) fn answer(&self, request: &str, answer: Value) {
        self.answer_text(request, &answer.to_string());
    }

    pub(crate) fn answer_text(&self, request: &str, answer: &str) {
        self.lock().answers.insert(request.to_owned(), answer.to_owned());
    }

    /// Changes objects as they are created.
    pub(crate) fn on_create(&self, edit: impl Fn(&mut Value) + Send + 'static) {
        self.lock().on_create = Some(Box::new(edit));
    }

    /// Somebody else changes the object just before the next patch of it.
    pub(crate) fn meanwhile(&self, edit: impl Fn(&mut Value) + Send + 'static) {
        self.lock().meanwhile = Some(Box::new(edit));
    }

    pub(crate) fn object(&self, key: &str) -> Option<Value> {
        self.lock().objects.get(key).cloned()
    }

    pub(crate) fn requests(&self) -> Vec<String> {
        self.lock().requests.clone()
    }

    pub(crate) fn last_body(&self) -> Value {
        self.lock().last_body.clone()
    }
}

/// What a path names.
#[derive(Clone)]
struct Path {
    plural: String,
    namespace: Option<String>,
    name: Option<String>,
}

impl Path {
    fn read(path: &str) -> Option<Path> {
        let parts: Vec<&str> = path.split('/').filter(|p| !p.is_empty()).collect();
        let rest = match parts[..] {
            ["api", "v1", ref rest @ ..] | ["apis", _, _, ref rest @ ..] => rest,
            _ => return None,
        };
        let own = |text: &str| Some(text.to_owned());
        let (namespace, rest) = match rest {
            ["namespaces", namespace, rest @ ..] if !rest.is_empty() => (own(namespace), rest),
            rest => (None, rest),
        };
        match rest {
            [plural] => Some(Path { plural: (*plural).to_owned(), namespace, name: None }),
            [plural, name] => {
                Some(Path { plural: (*plural).to_owned(), namespace, name: own(name) })
            }
            _ => None,
        }
    }

    fn key(&self, name: &str) -> String {
        match &self.namespace {
            Some(namespace) => format!("{}/{namespace}/{name}", self.plural),
            None => format!("{}/{name}", self.plural),
        }
    }

    fn holds(&self, key: &str) -> bool {
        let prefix = match &self.namespace {
            Some(namespace) => format!("{}/{namespace}/", self.plural),
            None => format!("{}/", self.plural),
        };
        key.starts_with(&prefix)
    }
}

fn failure(code: StatusCode, reason: &str, message: &str, details: Value) -> Response {
    let status = json!({
        "kind": "Status", "apiVersion": "v1", "status": "Failure", "code": code.as_u16(),
        "reason": reason, "message": message, "details": details,
    });
    (code, status.to_string()).into_response()
}

fn parameters(uri: &Uri) -> BTreeMap<String, String> {
    let query = uri.query().unwrap_or_default();
    form_urlencoded::parse(query.as_bytes()).into_owned().collect()
}

async fn handle(State(fake): State<Fake>, method: Method, uri: Uri, body: Bytes) -> Response {
    let request = format!("{method} {}", uri.path());
    let parameters = parameters(&uri);
    let body: Value = serde_json::from_slice(&body).unwrap_or_default();
    {
        let mut inner = fake.lock();
        inner.requests.push(format!("{method} {uri}"));
        if !body.is_null() {
            inner.last_body = body.clone();
        }
        if let Some(answer) = inner.answers.get(&request) {
            return answer.clone().into_response();
        }
    }
    // It checks nothing together, as an older controller.
    let path = Path::read(uri.path()).filter(|path| path.plural != "check");
    let Some(path) = path else {
        return failure(StatusCode::NOT_FOUND, "NotFound", "no such path", Value::Null);
    };
    if path.plural == "frameworks" && matches!(method, Method::POST | Method::PATCH) {
        let verb = if method == Method::POST { "create" } else { "patch" };
        let message = format!("{verb} is not supported on frameworks.muster.dev");
        let code = StatusCode::METHOD_NOT_ALLOWED;
        return failure(code, "MethodNotAllowed", &message, Value::Null);
    }
    if path.plural == "transaction" {
        return transaction(&fake, &body);
    }
    let dry = parameters.contains_key("dryRun");
    match (method, path.name.clone()) {
        (Method::GET, None) if parameters.contains_key("watch") => follow(fake, path, parameters),
        (Method::GET, None) => list(&fake, &path, &parameters),
        (Method::POST, None) => create(&fake, &path, body, dry),
        (method, Some(name)) => {
            let key = path.key(&name);
            let Some(object) = fake.object(&key) else {
                let message = format!("{} {name:?} not found", path.plural);
                let details = json!({"kind": path.plural, "name": name});
                return failure(StatusCode::NOT_FOUND, "NotFound", &message, details);
            };
            match method {
                Method::GET => object.to_string().into_response(),
                Method::PATCH => patch(&fake, &key, object, &body, dry),
                Method::DELETE => {
                    if !fake.lock().held.contains(&key) {
                        fake.remove(&key);
                    }
                    object.to_string().into_response()
                }
                _ => failure(StatusCode::METHOD_NOT_ALLOWED, "MethodNotAllowed", "no", Value::Null),
            }
        }
        _ => failure(StatusCode::METHOD_NOT_ALLOWED, "MethodNotAllowed", "no", Value::Null),
    }
}

fn transaction(fake: &Fake, body: &Value) -> Response {
    if fake.lock().moves > 0 {
        fake.lock().moves -= 1;
        return failure(StatusCode::CONFLICT, "Conflict", "the cluster has moved on", Value::Null);
    }
    let requests = body["requests"].as_array().cloned().unwrap_or_default();
    let of = |request: &Value| {
        let created = &request["create"];
        let named =
            ["patch", "check"].iter().map(|way| &request[*way]["of"]).find(|of| of.is_object());
        let named = named.unwrap_or_else(|| &created["metadata"]);
        let kind = named["kind"].as_str().or_else(|| created["kind"].as_str()).unwrap_or_default();
        let info = muster_api::kind::find_by_word(kind).expect("a kind");
        let text = |field: &str| named[field].as_str().map(str::to_owned);
        let namespace = text("namespace").filter(|_| info.namespaced);
        let path = Path { plural: info.plural.to_owned(), namespace, name: None };
        (path.key(&text("name").unwrap_or_default()), path, text("name").unwrap_or_default())
    };
    for (index, request) in requests.iter().enumerate() {
        let (_, _, name) = of(request);
        if refusal(fake, &name, false).is_some() {
            let inner = fake.lock();
            let all = inner.refused.iter().chain(&inner.refused_late);
            let (_, field, message) = all.clone().find(|(n, _, _)| *n == name).expect("refused");
            let status = json!({
                "kind": "Status", "status": "Failure", "reason": "Invalid", "code": 422, "message": "is invalid",
                "details": {"causes": [{"field": field, "message": message}]},
            });
            let refusals = json!({"refusals": [{"index": index, "status": status}]});
            return refusals.to_string().into_response();
        }
    }
    let objects: Vec<Value> = requests
        .iter()
        .map(|request| {
            let (key, path, _) = of(request);
            if request["create"].is_object() {
                drop(create(fake, &path, request["create"].clone(), false));
            } else if request["patch"].is_object() {
                let present = fake.object(&key).expect("it is there");
                drop(patch(fake, &key, present, &request["patch"]["patch"], false));
            }
            fake.object(&key).unwrap_or_default()
        })
        .collect();
    json!({ "objects": objects }).to_string().into_response()
}

fn refusal(fake: &Fake, name: &str, dry: bool) -> Option<Response> {
    let inner = fake.lock();
    let late = inner.refused_late.iter().filter(|_| !dry);
    let (_, field, message) = inner.refused.iter().chain(late).find(|(n, _, _)| n == name)?;
    let details = json!({"causes": [{"field": field, "message": message}]});
    Some(failure(StatusCode::UNPROCESSABLE_ENTITY, "Invalid", "is invalid", details))
}

fn create(fake: &Fake, path: &Path, mut object: Value, dry: bool) -> Response {
    let name = object["metadata"]["name"].as_str().unwrap_or_default().to_owned();
    let key = path.key(&name);
    if let Some(refused) = refusal(fake, &name, dry) {
        return refused;
    }
    if fake.object(&key).is_some() {
        let message = format!("{name:?} already exists");
        return failure(StatusCode::CONFLICT, "AlreadyExists", &message, Value::Null);
    }
    match muster_api::kind::admit(&object) {
        Ok(admitted) => object = admitted,
        Err(error) => {
            let message = error.to_string();
            return failure(StatusCode::UNPROCESSABLE_ENTITY, "Invalid", &message, Value::Null);
        }
    }
    if dry {
        return (StatusCode::CREATED, object.to_string()).into_response();
    }
    if let Some(edit) = &fake.lock().on_create {
        edit(&mut object);
    }
    fake.put(&key, object);
    let stored = fake.object(&key).unwrap_or_default();
    (StatusCode::CREATED, stored.to_string()).into_response()
}

fn patch(fake: &Fake, key: &str, mut object: Value, patch: &Value, dry: bool) -> Response {
    let name = object["metadata"]["name"].as_str().unwrap_or_default().to_owned();
    if let Some(refused) = refusal(fake, &name, dry) {
        return refused;
    }
    let meanwhile = fake.lock().meanwhile.take();
    if let Some(edit) = meanwhile {
        edit(&mut object);
        fake.put(key, object);
        object = fake.object(key).unwrap_or_default();
    }
    let known = patch.pointer("/metadata/resourceVersion").filter(|known| !known.is_null());
    if known.is_some_and(|known| *known != object["metadata"]["resourceVersion"]) {
        let message = format!("{name} has changed");
        return failure(StatusCode::CONFLICT, "Conflict", &message, Value::Null);
    }
    json_patch::merge(&mut object, patch);
    if !dry {
        fake.put(key, object.clone());
    }
    object.to_string().into_response()
}

fn selected(object: &Value, parameters: &BTreeMap<String, String>) -> bool {
    let fields = parameters.get("fieldSelector").map_or("", String::as_str);
    muster_api::selector::FieldSelector::parse(fields).expect("a selector").matches(object)
}

fn list(fake: &Fake, path: &Path, parameters: &BTreeMap<String, String>) -> Response {
    let inner = fake.lock();
    let items: Vec<&Value> = inner
        .objects
        .iter()
        .filter(|(key, object)| path.holds(key) && selected(object, parameters))
        .map(|(_, object)| object)
        .collect();
    let revision = inner.revision.to_string();
    json!({"metadata": {"resourceVersion": revision}, "items": items}).to_string().into_response()
}

/// A watch that resumes, and ends with a 410 when its revision was compacted.
fn follow(fake: Fake, path: Path, parameters: BTreeMap<String, String>) -> Response {
    let from: u64 = parameters.get("resourceVersion").and_then(|r| r.parse().ok()).unwrap_or(0);
    let changed = fake.changed.subscribe();
    let stream = futures::stream::unfold((Some(from), changed), move |(at, mut changed)| {
        let (fake, path, parameters) = (fake.clone(), path.clone(), parameters.clone());
        async move {
            let at = at?;
            loop {
                if let Some((line, next)) = fake.lock().after(at, &path, &parameters) {
                    return Some((Ok::<_, io::Error>(format!("{line}\n")), (next, changed)));
                }
                changed.changed().await.ok()?;
            }
        }
    });
    Response::new(Body::from_stream(stream))
}

impl Inner {
    /// The event after a revision and where to go on; nowhere after an error.
    fn after(
        &self,
        at: u64,
        path: &Path,
        parameters: &BTreeMap<String, String>,
    ) -> Option<(Value, Option<u64>)> {
        if at < self.compacted {
            let status = json!({"code": 410, "reason": "Expired", "message": "compacted"});
            return Some((json!({"type": "ERROR", "object": status}), None));
        }
        let (revision, event, _, object) = self.history.iter().find(|(r, _, key, object)| {
            *r > at && path.holds(key) && selected(object, parameters)
        })?;
        Some((json!({"type": event, "object": object}), Some(*revision)))
    }
}
