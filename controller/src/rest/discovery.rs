//! What there is to ask for: `/api`, `/apis`, the resource lists and `/version`.

use http::StatusCode;
use muster_api::{API_VERSION, GROUP, VERSION};
use serde_json::{Value, json};

use super::path::{Discovery, Verb};
use super::registry::{self, Entry};
use super::{Answer, json as answer_json};

pub(super) fn answer(what: Discovery) -> Answer {
    let value = match what {
        Discovery::Root => json!({"paths": [
            "/api", "/api/v1", "/apis", format!("/apis/{GROUP}"), format!("/apis/{API_VERSION}"),
            "/healthz", "/livez", "/metrics", "/readyz", "/version",
        ]}),
        Discovery::Core => json!({
            "kind": "APIVersions", "versions": ["v1"],
            "serverAddressByClientCIDRs": [],
        }),
        Discovery::Groups => json!({
            "kind": "APIGroupList", "apiVersion": "v1", "groups": [group()],
        }),
        Discovery::Group => group(),
        Discovery::Resources(group) => resources(group),
    };
    Ok(answer_json(StatusCode::OK, &value))
}

fn group() -> Value {
    let version = json!({"groupVersion": API_VERSION, "version": VERSION});
    json!({
        "kind": "APIGroup", "apiVersion": "v1", "name": GROUP,
        "versions": [version], "preferredVersion": version,
    })
}

fn resources(group: &str) -> Value {
    let served = registry::all().iter().filter(|entry| entry.info.group == group);
    let resources: Vec<Value> = served.flat_map(resource).collect();
    let version = if group.is_empty() { "v1" } else { API_VERSION };
    json!({
        "kind": "APIResourceList", "apiVersion": "v1",
        "groupVersion": version, "resources": resources,
    })
}

fn resource(entry: &Entry) -> Vec<Value> {
    let info = entry.info;
    let verbs = |of: &[Verb]| -> Vec<&str> { of.iter().map(|verb| verb.as_str()).collect() };
    let mut all = vec![json!({
        "name": info.plural,
        "singularName": info.singular,
        "namespaced": info.namespaced,
        "kind": info.kind,
        "verbs": verbs(entry.verbs),
        "shortNames": info.short_names,
        "categories": entry.categories,
    })];
    let mut sub = |name: &str, kind: &str, verbs: Vec<&str>| {
        all.push(json!({
            "name": format!("{}/{name}", info.plural),
            "singularName": "",
            "namespaced": info.namespaced,
            "kind": kind,
            "verbs": verbs,
        }));
    };
    if info.has_status {
        let writable = entry.verbs.contains(&Verb::Update);
        let of: &[Verb] =
            if writable { &[Verb::Get, Verb::Patch, Verb::Update] } else { &[Verb::Get] };
        sub("status", info.kind, verbs(of));
    }
    if entry.has_log {
        sub("log", info.kind, vec!["get"]);
    }
    if info.kind == "Node" {
        sub("fence", "NodeFence", vec!["create"]);
    }
    if info.kind == "TaskSet" {
        all.push(json!({
            "name": format!("{}/scale", info.plural),
            "singularName": "",
            "namespaced": true,
            "group": "autoscaling",
            "version": "v1",
            "kind": "Scale",
            "verbs": ["get", "patch", "update"],
        }));
    }
    all
}

/// What `/version` says. `major` and `minor` are those of the Kubernetes API whose conventions are kept.
pub(super) fn version() -> Value {
    json!({
        "major": "1",
        "minor": "33",
        "gitVersion": concat!("v1.33.0+muster.", env!("CARGO_PKG_VERSION")),
        "gitCommit": "",
        "gitTreeState": "",
        "buildDate": "",
        "goVersion": "",
        "compiler": "rustc",
        "platform": format!("{}/{}", std::env::consts::OS, std::env::consts::ARCH),
    })
}
