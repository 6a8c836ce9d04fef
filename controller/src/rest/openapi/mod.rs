//! `/openapi/v3`: an index, and a document a group, made once from the Rust types. `kubectl explain`, `apply`, `create`,
//! `replace` and `edit` read them.

mod operations;
mod questions;
mod schemas;

use std::collections::BTreeMap;
use std::sync::{LazyLock, PoisonError, RwLock};

use axum::body::Body;
use bytes::Bytes;
use http::{HeaderValue, Request, StatusCode, header};
use serde_json::{Map, Value, json};

use super::discovery::{ApiGroup, GROUPS};
use super::registry;
use super::{Answer, json as answer_json, raw};

/// A document, and the hash by which clients keep it.
#[derive(Debug, Clone)]
struct Document {
    bytes: Bytes,
    hash: String,
}

/// Made when somebody asks first: most controllers are never asked, and the core document is large.
static MADE: LazyLock<RwLock<BTreeMap<&'static str, Document>>> = LazyLock::new(RwLock::default);

pub(super) fn answer(request: &Request<Body>, of: Option<&'static ApiGroup>) -> Answer {
    let Some(group) = of else { return Ok(answer_json(StatusCode::OK, &index())) };
    let document = document(group);
    let tag = format!("\"{}\"", document.hash);
    let known = request.headers().get(header::IF_NONE_MATCH);
    let mut response = if known.is_some_and(|known| *known == *tag) {
        raw(StatusCode::NOT_MODIFIED, Body::empty())
    } else {
        raw(StatusCode::OK, document.bytes)
    };
    if let Ok(tag) = HeaderValue::try_from(tag) {
        response.headers_mut().insert(header::ETAG, tag);
    }
    Ok(response)
}

fn path(group: &ApiGroup) -> String {
    let root = if group.name.is_empty() { "api" } else { "apis" };
    format!("{root}/{}", group.api_version())
}

fn index() -> Value {
    let paths: Map<String, Value> = GROUPS
        .iter()
        .map(|group| {
            let path = path(group);
            let url = format!("/openapi/v3/{path}?hash={}", document(group).hash);
            (path, json!({ "serverRelativeURL": url }))
        })
        .collect();
    json!({ "paths": paths })
}

fn document(group: &'static ApiGroup) -> Document {
    if let Some(made) = MADE.read().unwrap_or_else(PoisonError::into_inner).get(group.name) {
        return made.clone();
    }
    let bytes = Bytes::from(make(group).to_string());
    let digest = ring::digest::digest(&ring::digest::SHA256, &bytes);
    let hash = crate::pki::hex(digest.as_ref()).to_uppercase();
    let document = Document { bytes, hash };
    MADE.write().unwrap_or_else(PoisonError::into_inner).insert(group.name, document.clone());
    document
}

fn make(group: &ApiGroup) -> Value {
    let mut paths = Map::new();
    let mut components = schemas::Components::new();
    let served = registry::all();
    for entry in served.iter().filter(|entry| entry.info.group == group.name) {
        let schema = components.add(entry.info);
        operations::of_kind(entry, &schema, &mut paths);
    }
    questions::of_group(group, &mut paths);
    json!({
        "openapi": "3.0.0",
        "info": {"title": "muster", "version": env!("CARGO_PKG_VERSION")},
        "paths": paths,
        "components": {"schemas": components.finish()},
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every `$ref` leads somewhere, and nothing is left that OpenAPI 3.0 does not know.
    fn check(value: &Value, schemas: &Map<String, Value>, at: &str) {
        match value {
            Value::Object(members) => {
                if let Some(target) = members.get("$ref").and_then(Value::as_str) {
                    let name = target.strip_prefix("#/components/schemas/");
                    assert!(name.is_some_and(|n| schemas.contains_key(n)), "{at}: {target}");
                }
                for word in ["const", "$defs", "$schema", "oneOf"] {
                    let is_field = at.ends_with("properties");
                    assert!(is_field || !members.contains_key(word), "{at} has {word}: {value}");
                }
                let is_type = |t: &Value| t.is_string() || at.ends_with("properties");
                assert!(members.get("type").is_none_or(is_type), "{at}: {value}");
                for (name, member) in members {
                    check(member, schemas, &format!("{at}/{name}"));
                }
            }
            Value::Array(elements) => {
                elements.iter().for_each(|element| check(element, schemas, at));
            }
            _ => {}
        }
    }

    #[test]
    fn documents_are_whole_and_name_their_kinds() {
        for group in GROUPS {
            let document = make(group);
            let schemas = document["components"]["schemas"].as_object().unwrap();
            check(&document, schemas, "");
            let kinds: Vec<&Value> = schemas
                .values()
                .filter_map(|schema| schema["x-kubernetes-group-version-kind"].as_array())
                .flatten()
                .map(|kind| &kind["kind"])
                .collect();
            for entry in registry::all().iter().filter(|e| e.info.group == group.name) {
                assert!(kinds.iter().any(|kind| **kind == entry.info.kind), "{}", entry.info.kind);
            }
        }
        let ours = make(&GROUPS[1]);
        let task = &ours["components"]["schemas"]["dev.muster.v1alpha1.TaskSpec"]["properties"];
        assert_eq!(task["priority"]["type"], "integer", "{task}");
        assert_eq!(task["restartPolicy"]["default"], "Never", "{task}");
        let patch = &ours["paths"]["/apis/muster.dev/v1alpha1/namespaces/{namespace}/tasks/{name}"]
            ["patch"];
        assert_eq!(patch["x-kubernetes-group-version-kind"]["kind"], "Task");
    }

    #[test]
    fn everything_that_discovery_names_is_in_the_documents() {
        let has = |group: &ApiGroup, path: &str| {
            let (document, start) = (make(group), super::path(group));
            assert!(document["paths"].get(format!("/{start}/{path}")).is_some(), "{start}/{path}");
        };
        let core = &GROUPS[0];
        for sub in ["attach", "eviction", "exec", "log", "status"] {
            has(core, &format!("namespaces/{{namespace}}/pods/{{name}}/{sub}"));
        }
        let ours = &GROUPS[1];
        let questions =
            ["check", "join", "jointokens", "offers", "plan", "poses", "transaction", "usage"];
        for question in questions {
            has(ours, question);
        }
        for sub in ["fence", "pose", "status"] {
            has(ours, &format!("nodes/{{name}}/{sub}"));
        }
        has(ours, "namespaces/{namespace}/tasks/{name}/why");
        has(ours, "namespaces/{namespace}/tasksets/{name}/scale");
        for path in ["nodes/{name}", "namespaces/{namespace}/pods/{name}"] {
            has(&GROUPS[4], path);
        }
        let document = make(core);
        let list = &document["paths"]["/api/v1/pods"]["get"]["parameters"];
        let named = |name: &str| list.as_array().unwrap().iter().any(|p| p["name"] == name);
        for parameter in ["watch", "resourceVersion", "timeoutSeconds", "limit", "labelSelector"] {
            assert!(named(parameter), "{parameter}");
        }
    }
}
