//! Paths and operations: one set a kind, from the verbs that it is served with.

use serde_json::{Map, Value, json};

use super::super::path::Verb;
use super::super::registry::{Entry, View};
use super::questions;

const REF: &str = "#/components/schemas/";
const META: &str = "#/components/schemas/io.k8s.apimachinery.pkg.apis.meta.v1.";

/// The operations on a kind.
pub(super) fn of_kind(entry: &Entry, schema: &str, paths: &mut Map<String, Value>) {
    let info = entry.info;
    let root = if info.group.is_empty() { "/api" } else { "/apis" };
    let root = format!("{root}/{}", info.api_version());
    let scope = if info.namespaced { "/namespaces/{namespace}" } else { "" };
    let all = format!("{root}{scope}/{}", info.plural);
    let one = format!("{all}/{{name}}");
    let maker = Maker { entry, schema };
    let mut collection = maker.path(&[]);
    for verb in [Verb::List, Verb::Create, Verb::DeleteCollection] {
        maker.operation(verb, &mut collection);
    }
    paths.insert(all, collection);
    if info.namespaced {
        let mut everywhere = json!({});
        maker.operation(Verb::List, &mut everywhere);
        paths.insert(format!("{root}/{}", info.plural), everywhere);
    }
    let mut object = maker.path(&["name"]);
    for verb in [Verb::Get, Verb::Update, Verb::Patch, Verb::Delete] {
        maker.operation(verb, &mut object);
    }
    paths.insert(one.clone(), object);
    if info.has_status {
        let mut status = maker.path(&["name"]);
        maker.operation(Verb::Get, &mut status);
        if entry.view == View::Stored {
            maker.operation(Verb::Update, &mut status);
            maker.operation(Verb::Patch, &mut status);
        }
        paths.insert(format!("{one}/status"), status);
    }
    questions::of_kind(entry, &one, paths);
}

struct Maker<'a> {
    entry: &'a Entry,
    schema: &'a str,
}

impl Maker<'_> {
    /// A path with the parameters that stand in it.
    fn path(&self, more: &[&str]) -> Value {
        let namespace = self.entry.info.namespaced.then_some("namespace");
        json!({ "parameters": in_path(namespace.iter().chain(more).copied()) })
    }

    /// Adds the operation of a verb, if the kind has it.
    fn operation(&self, verb: Verb, path: &mut Value) {
        if !self.entry.verbs.contains(&verb) {
            return;
        }
        let info = self.entry.info;
        let object = format!("{REF}{}", self.schema);
        let list = format!("{object}List");
        let write = [
            query("dryRun", "string"),
            query("fieldManager", "string"),
            query("fieldValidation", "string"),
        ];
        let select = [query("labelSelector", "string"), query("fieldSelector", "string")];
        let (method, action, parameters, body, answer) = match verb {
            Verb::Get => ("get", "get", vec![query("resourceVersion", "string")], None, object),
            Verb::List | Verb::Watch => {
                let numbers = ["limit", "timeoutSeconds"].map(|name| query(name, "integer"));
                let flags = ["watch", "allowWatchBookmarks", "sendInitialEvents"];
                let flags = flags.map(|name| query(name, "boolean"));
                let texts = ["continue", "resourceVersion", "resourceVersionMatch"];
                let texts = texts.map(|name| query(name, "string"));
                let more = numbers.into_iter().chain(flags).chain(texts);
                ("get", "list", select.into_iter().chain(more).collect(), None, list)
            }
            Verb::Create => ("post", "post", write.to_vec(), Some(self.whole()), object),
            Verb::Update => ("put", "put", write.to_vec(), Some(self.whole()), object),
            Verb::Patch => {
                let parameters = write.into_iter().chain([query("force", "boolean")]).collect();
                ("patch", "patch", parameters, Some(self.patches()), object)
            }
            Verb::Delete => (
                "delete",
                "delete",
                vec![
                    query("dryRun", "string"),
                    query("gracePeriodSeconds", "integer"),
                    query("propagationPolicy", "string"),
                ],
                Some(
                    json!({"application/json": {"schema": {"$ref": format!("{META}DeleteOptions")}}}),
                ),
                format!("{META}Status"),
            ),
            Verb::DeleteCollection => ("delete", "deletecollection", select.to_vec(), None, list),
        };
        let mut operation = json!({
            "parameters": parameters,
            "responses": {
                "200": {"description": "OK", "content": {"application/json": {"schema": {"$ref": answer}}}},
            },
            "x-kubernetes-action": action,
            "x-kubernetes-group-version-kind":
                {"group": info.group, "version": info.version, "kind": info.kind},
        });
        if let Some(content) = body {
            operation["requestBody"] =
                json!({"required": verb != Verb::Delete, "content": content});
        }
        path[method] = operation;
    }

    fn whole(&self) -> Value {
        json!({"application/json": {"schema": {"$ref": format!("{REF}{}", self.schema)}}})
    }

    fn patches(&self) -> Value {
        let patch = json!({"schema": {"type": "object"}});
        let mut content = json!({
            "application/apply-patch+yaml": patch,
            "application/json-patch+json": {"schema": {"type": "array", "items": {"type": "object"}}},
            "application/merge-patch+json": patch,
        });
        if self.entry.info.group.is_empty() {
            content["application/strategic-merge-patch+json"] = patch;
        }
        content
    }
}

/// Parameters that stand in the path.
pub(super) fn in_path<'a>(names: impl Iterator<Item = &'a str>) -> Vec<Value> {
    let of = |name: &str| {
        json!({"name": name, "in": "path", "required": true,
               "schema": {"type": "string", "uniqueItems": true}})
    };
    names.map(of).collect()
}

pub(super) fn query(name: &str, r#type: &str) -> Value {
    json!({"name": name, "in": "query", "schema": {"type": r#type, "uniqueItems": true}})
}
