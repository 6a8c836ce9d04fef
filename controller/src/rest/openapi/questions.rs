//! Paths that are no objects and no verbs on objects: subresources that do something, and questions to a group.

use serde_json::{Map, Value, json};

use super::super::discovery::ApiGroup;
use super::super::metrics_api;
use super::super::registry::{Entry, View};
use super::operations::{in_path, query};

/// What is sent, what is answered, and what stands in the query.
struct Operation {
    method: &'static str,
    said: &'static str,
    body: Option<Value>,
    code: &'static str,
    media: &'static str,
    parameters: Vec<Value>,
}

impl Operation {
    fn get(said: &'static str) -> Self {
        let (method, code, media) = ("get", "200", "application/json");
        Self { method, said, body: None, code, media, parameters: Vec::new() }
    }

    /// With a body of this schema.
    fn post(said: &'static str, body: Value) -> Self {
        Self { method: "post", body: Some(body), ..Self::get(said) }
    }

    fn with(self, parameters: impl IntoIterator<Item = Value>) -> Self {
        Self { parameters: parameters.into_iter().collect(), ..self }
    }

    fn created(self) -> Self {
        Self { code: "201", ..self }
    }

    fn put_into(self, path: &mut Value) {
        let schema =
            if self.media == "text/plain" { json!({"type": "string"}) } else { object(&[]) };
        let answer = json!({"description": self.said, "content": {self.media: {"schema": schema}}});
        let mut operation = json!({
            "description": self.said, "parameters": self.parameters, "responses": {self.code: answer},
        });
        if let Some(schema) = self.body {
            operation["requestBody"] = json!({"content": {"application/json": {"schema": schema}}});
        }
        path[self.method] = operation;
    }
}

fn object(properties: &[(&str, Value)]) -> Value {
    if properties.is_empty() {
        return json!({"type": "object"});
    }
    let properties: Map<String, Value> =
        properties.iter().map(|(name, schema)| ((*name).to_owned(), schema.clone())).collect();
    json!({"type": "object", "properties": properties})
}

fn text() -> Value {
    json!({"type": "string"})
}

fn objects() -> Value {
    object(&[("objects", json!({"type": "array", "items": {"type": "object"}}))])
}

/// The subresources of a kind that do something or say something. `one` is the path of an object.
pub(super) fn of_kind(entry: &Entry, one: &str, paths: &mut Map<String, Value>) {
    let mut sub = |name: &str, operations: Vec<Operation>| {
        let namespace = entry.info.namespaced.then_some("namespace");
        let mut path = json!({ "parameters": in_path(namespace.iter().copied().chain(["name"])) });
        for operation in operations {
            operation.put_into(&mut path);
        }
        paths.insert(format!("{one}/{name}"), path);
    };
    if entry.has_log {
        let log = Operation { media: "text/plain", ..Operation::get("What it writes.") };
        let flags = ["follow", "previous", "timestamps"].map(|name| query(name, "boolean"));
        let numbers =
            ["sinceSeconds", "tailLines", "limitBytes"].map(|name| query(name, "integer"));
        let texts = ["container", "sinceTime"].map(|name| query(name, "string"));
        sub("log", vec![log.with([flags.to_vec(), numbers.to_vec(), texts.to_vec()].concat())]);
    }
    if entry.has_why {
        sub("why", vec![Operation::get("Why it waits, node by node.")]);
    }
    match (entry.info.kind, entry.view) {
        ("Pod", _) => {
            let streams = ["stdin", "stdout", "stderr", "tty"].map(|name| query(name, "boolean"));
            let streams = [streams.to_vec(), vec![query("container", "string")]].concat();
            let command = json!({"name": "command", "in": "query", "schema": {"type": "array", "items": text()}});
            let exec = [streams.clone(), vec![command]].concat();
            let over = |said, parameters: &[Value]| {
                let get = Operation::get(said).with(parameters.to_vec());
                vec![
                    get,
                    Operation { method: "post", ..Operation::get(said) }.with(parameters.to_vec()),
                ]
            };
            sub("exec", over("A program in it, over a WebSocket.", &exec));
            sub("attach", over("What it writes, over a WebSocket.", &streams));
            let eviction = object(&[("metadata", object(&[])), ("deleteOptions", object(&[]))]);
            let evict = Operation::post("It ends, unless its robot is on a mission.", eviction);
            sub("eviction", vec![evict.created().with([query("dryRun", "string")])]);
        }
        ("Node", View::Stored) => {
            let word = object(&[("reason", text()), ("by", text())]);
            sub("fence", vec![Operation::post("A person confirms that it is off.", word)]);
            sub("pose", vec![Operation::get("Where it is now.")]);
        }
        ("Lease", _) => {
            let why = || object(&[("reason", text())]);
            let post = |said| vec![Operation::post(said, why())];
            sub("acquire", post("A person holds it, if nobody does."));
            sub("take", post("A person holds it, whoever did."));
            sub("return", post("The person gives it back."));
        }
        ("Framework", _) => {
            let number = || json!({"type": "number"});
            let place = [("x", number()), ("y", number()), ("z", number()), ("map", text())];
            let spec = [("position", object(&place)), ("radius", number()), ("cost", text())];
            let body = object(&[("spec", object(&spec))]);
            sub("position", vec![Operation::post("It works there from now on.", body)]);
        }
        ("TaskSet", _) => {
            let replicas = object(&[("replicas", json!({"type": "integer"}))]);
            let scale = object(&[
                ("apiVersion", text()),
                ("kind", text()),
                ("metadata", object(&[])),
                ("spec", replicas),
            ]);
            let put =
                Operation { method: "put", ..Operation::post("How many tasks it has.", scale) };
            let mut patch =
                Operation { method: "patch", ..Operation::get("How many tasks it has.") };
            patch.parameters =
                ["dryRun", "fieldManager"].map(|name| query(name, "string")).to_vec();
            sub("scale", vec![Operation::get("How many tasks it has."), put, patch]);
            // A patch has a media type of its own.
            if let Some(path) = paths.get_mut(&format!("{one}/scale")) {
                let merge = json!({"application/merge-patch+json": {"schema": object(&[])}});
                path["patch"]["requestBody"] = json!({ "content": merge });
            }
        }
        _ => {}
    }
}

/// The questions of a group.
pub(super) fn of_group(group: &ApiGroup, paths: &mut Map<String, Value>) {
    let root = format!("/apis/{}", group.api_version());
    let mut at = |path: &str, names: &[&str], operations: Vec<Operation>| {
        let mut item = json!({ "parameters": in_path(names.iter().copied()) });
        for operation in operations {
            operation.put_into(&mut item);
        }
        paths.insert(format!("{root}/{path}"), item);
    };
    let ask = |said| vec![Operation::post(said, object(&[])).created()];
    match group.name {
        "authorization.k8s.io" => {
            at("selfsubjectaccessreviews", &[], ask("Whether the client may do something."));
            at("selfsubjectrulesreviews", &[], ask("What the client may do."));
            at("subjectaccessreviews", &[], ask("Whether somebody may do something."));
        }
        "authentication.k8s.io" => at("selfsubjectreviews", &[], ask("Who the client is.")),
        metrics_api::GROUP => {
            let selectors = || ["labelSelector", "fieldSelector"].map(|name| query(name, "string"));
            let list = |said| vec![Operation::get(said).with(selectors())];
            at("nodes", &[], list("What nodes use."));
            at("nodes/{name}", &["name"], vec![Operation::get("What a node uses.")]);
            at("pods", &[], list("What tasks use."));
            at("namespaces/{namespace}/pods", &["namespace"], list("What tasks use."));
            let one = vec![Operation::get("What a task uses.")];
            at("namespaces/{namespace}/pods/{name}", &["namespace", "name"], one);
        }
        muster_api::GROUP => {
            at("plan", &[], vec![Operation::post("What applying objects would do.", objects())]);
            at("check", &[], vec![Operation::post("What objects have wrong together.", objects())]);
            let requests = json!({"type": "array", "items": {"type": "object"}});
            let transaction = object(&[("revision", text()), ("requests", requests)]);
            at("transaction", &[], vec![Operation::post("Objects in one commit.", transaction)]);
            let join = ["token", "nodeName", "kind", "csr"].map(|name| (name, text()));
            at("join", &[], vec![Operation::post("A token against a certificate.", object(&join))]);
            at("usage", &[], vec![Operation::get("What nodes and tasks use.")]);
            at("offers", &[], vec![Operation::get("What frameworks are offered.")]);
            let of = ["nodes", "map"].map(|name| query(name, "string")).to_vec();
            let lasts = vec![query("watch", "boolean"), query("timeoutSeconds", "integer")];
            let poses = Operation::get("Where robots are now.").with([of, lasts].concat());
            at("poses", &[], vec![poses]);
            let spec = object(&[("ttlSeconds", json!({"type": "integer"})), ("nodeName", text())]);
            let token = Operation::post("A new join token.", object(&[("spec", spec)])).created();
            at("jointokens", &[], vec![Operation::get("The join tokens."), token]);
            let end =
                Operation { method: "delete", ..Operation::get("It admits nobody any more.") };
            let one = vec![Operation::get("A join token."), end];
            at("jointokens/{id}", &["id"], one);
            let groups = json!({"type": "array", "items": text()});
            let ttl = json!({"type": "integer"});
            let spec = object(&[("user", text()), ("groups", groups), ("ttlSeconds", ttl)]);
            let token = Operation::post("A new token of a user.", object(&[("spec", spec)]));
            at("usertokens", &[], vec![Operation::get("The users' tokens."), token.created()]);
            let end =
                Operation { method: "delete", ..Operation::get("It admits nobody any more.") };
            let one = vec![Operation::get("A token of a user."), end];
            at("usertokens/{id}", &["id"], one);
        }
        _ => {}
    }
}
