//! What there is to ask for: `/api`, `/apis`, the resource lists, all of it at once for clients that know the aggregated
//! form, and `/version`.

use axum::body::Body;
use http::{HeaderValue, Request, StatusCode, header};
use muster_api::{GROUP, VERSION};
use serde_json::{Value, json};

use super::path::{Discovery, Verb};
use super::registry::{self, Entry};
use super::{Answer, json as answer_json, metrics_api};

/// A group of the API in its one version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ApiGroup {
    /// Empty for the core group.
    pub name: &'static str,
    /// The version.
    pub version: &'static str,
}

impl ApiGroup {
    /// `group/version`, or `version` of the core group.
    #[must_use]
    pub fn api_version(&self) -> String {
        if self.name.is_empty() {
            self.version.to_owned()
        } else {
            format!("{}/{}", self.name, self.version)
        }
    }
}

/// Every group. A name that several of them have is that of the first.
pub(super) const GROUPS: &[ApiGroup] = &[
    ApiGroup { name: "", version: "v1" },
    ApiGroup { name: GROUP, version: VERSION },
    ApiGroup { name: "authentication.k8s.io", version: "v1" },
    ApiGroup { name: "authorization.k8s.io", version: "v1" },
    ApiGroup { name: metrics_api::GROUP, version: metrics_api::VERSION },
];

/// The group of this name and version.
pub(super) fn find(name: &str, version: &str) -> Option<&'static ApiGroup> {
    GROUPS.iter().find(|group| group.name == name && group.version == version)
}

/// The group of this name that is not the core group.
pub(super) fn named(name: &str) -> Option<&'static ApiGroup> {
    GROUPS.iter().find(|group| group.name == name && !name.is_empty())
}

/// One resource or subresource, as both forms of discovery show it.
struct Shown {
    name: String,
    singular: &'static str,
    namespaced: bool,
    /// Group and version of what is sent and answered, where they are not those of the resource.
    of: Option<(&'static str, &'static str)>,
    kind: &'static str,
    verbs: Vec<&'static str>,
    short_names: &'static [&'static str],
    categories: &'static [&'static str],
}

const AGGREGATED: &str = "application/json;g=apidiscovery.k8s.io;v=v2;as=APIGroupDiscoveryList";

pub(super) fn answer(request: &Request<Body>, what: Discovery) -> Answer {
    let all = |core: bool| GROUPS.iter().filter(move |group| group.name.is_empty() == core);
    if matches!(what, Discovery::Core | Discovery::Groups) && takes_aggregated(request) {
        let items: Vec<Value> = all(what == Discovery::Core).map(aggregated).collect();
        let list = json!({
            "kind": "APIGroupDiscoveryList", "apiVersion": "apidiscovery.k8s.io/v2",
            "metadata": {}, "items": items,
        });
        let mut response = answer_json(StatusCode::OK, &list);
        let media = HeaderValue::from_static(AGGREGATED);
        response.headers_mut().insert(header::CONTENT_TYPE, media);
        return Ok(response);
    }
    let value = match what {
        Discovery::Root => json!({"paths": paths()}),
        Discovery::Core => json!({
            "kind": "APIVersions", "versions": ["v1"],
            "serverAddressByClientCIDRs": [],
        }),
        Discovery::Groups => {
            let groups: Vec<Value> = all(false).map(group).collect();
            json!({"kind": "APIGroupList", "apiVersion": "v1", "groups": groups})
        }
        Discovery::Group(of) => {
            let mut value = group(of);
            value["kind"] = "APIGroup".into();
            value["apiVersion"] = "v1".into();
            value
        }
        Discovery::Resources(group) => resource_list(group),
    };
    Ok(answer_json(StatusCode::OK, &value))
}

fn takes_aggregated(request: &Request<Body>) -> bool {
    let accept = request.headers().get(header::ACCEPT).and_then(|value| value.to_str().ok());
    accept.unwrap_or_default().split(',').any(|clause| {
        let has = |part: &str| clause.split(';').any(|p| p.trim() == part);
        has("as=APIGroupDiscoveryList") && has("v=v2")
    })
}

fn paths() -> Vec<String> {
    let fixed = [
        "/api",
        "/api/v1",
        "/apis",
        "/healthz",
        "/livez",
        "/metrics",
        "/openapi/v3",
        "/readyz",
        "/version",
    ];
    let of = |group: &ApiGroup| {
        [format!("/apis/{}", group.name), format!("/apis/{}", group.api_version())]
    };
    let groups = GROUPS.iter().filter(|group| !group.name.is_empty()).flat_map(of);
    let mut paths: Vec<String> = fixed.map(str::to_owned).into_iter().chain(groups).collect();
    paths.sort_unstable();
    paths
}

fn group(of: &ApiGroup) -> Value {
    let version = json!({"groupVersion": of.api_version(), "version": of.version});
    json!({"name": of.name, "versions": [version], "preferredVersion": version})
}

fn resource_list(of: &ApiGroup) -> Value {
    let one = |shown: Shown| {
        let mut value = json!({
            "name": shown.name,
            "singularName": shown.singular,
            "namespaced": shown.namespaced,
            "kind": shown.kind,
            "verbs": shown.verbs,
        });
        if let Some((group, version)) = shown.of {
            value["group"] = group.into();
            value["version"] = version.into();
        }
        for (field, list) in [("shortNames", shown.short_names), ("categories", shown.categories)] {
            if !list.is_empty() {
                value[field] = json!(list);
            }
        }
        value
    };
    json!({
        "kind": "APIResourceList", "apiVersion": "v1", "groupVersion": of.api_version(),
        "resources": resources(of).into_iter().map(one).collect::<Vec<_>>(),
    })
}

fn aggregated(of: &ApiGroup) -> Value {
    let mut listed: Vec<Value> = Vec::new();
    for shown in resources(of) {
        let (group, version) = shown.of.unwrap_or((of.name, of.version));
        let kind = json!({"group": group, "version": version, "kind": shown.kind});
        if let Some((_, sub)) = shown.name.split_once('/') {
            let sub = json!({"subresource": sub, "responseKind": kind, "verbs": shown.verbs});
            if let Some(list) =
                listed.last_mut().and_then(|main| main["subresources"].as_array_mut())
            {
                list.push(sub);
            }
            continue;
        }
        listed.push(json!({
            "resource": shown.name, "responseKind": kind,
            "scope": if shown.namespaced { "Namespaced" } else { "Cluster" },
            "singularResource": shown.singular, "verbs": shown.verbs,
            "shortNames": shown.short_names, "categories": shown.categories, "subresources": [],
        }));
    }
    json!({
        "metadata": {"name": of.name, "creationTimestamp": null},
        "versions": [{"version": of.version, "resources": listed, "freshness": "Current"}],
    })
}

fn resources(of: &ApiGroup) -> Vec<Shown> {
    let simple = |name: &str, kind, namespaced, verbs: &[&'static str]| Shown {
        name: name.to_owned(),
        singular: "",
        namespaced,
        of: None,
        kind,
        verbs: verbs.to_vec(),
        short_names: &[],
        categories: &[],
    };
    match of.name {
        "authentication.k8s.io" => {
            vec![simple("selfsubjectreviews", "SelfSubjectReview", false, &["create"])]
        }
        "authorization.k8s.io" => vec![
            simple("selfsubjectaccessreviews", "SelfSubjectAccessReview", false, &["create"]),
            simple("selfsubjectrulesreviews", "SelfSubjectRulesReview", false, &["create"]),
            simple("subjectaccessreviews", "SubjectAccessReview", false, &["create"]),
        ],
        metrics_api::GROUP => vec![
            simple("nodes", "NodeMetrics", false, &["get", "list"]),
            simple("pods", "PodMetrics", true, &["get", "list"]),
        ],
        group => {
            let served = registry::all().iter().filter(|entry| entry.info.group == group);
            served.flat_map(resource).collect()
        }
    }
}

fn resource(entry: &Entry) -> Vec<Shown> {
    let info = entry.info;
    let mut all = vec![Shown {
        name: info.plural.to_owned(),
        singular: info.singular,
        namespaced: info.namespaced,
        of: None,
        kind: info.kind,
        verbs: entry.verbs.iter().map(|verb| verb.as_str()).collect(),
        short_names: info.short_names,
        categories: entry.categories,
    }];
    let mut sub = |name: &str, of, kind, verbs: &[&'static str]| {
        all.push(Shown {
            name: format!("{}/{name}", info.plural),
            singular: "",
            namespaced: info.namespaced,
            of,
            kind,
            verbs: verbs.to_vec(),
            short_names: &[],
            categories: &[],
        });
    };
    if info.has_status {
        let writable = entry.verbs.contains(&Verb::Update) && entry.view == registry::View::Stored;
        sub(
            "status",
            None,
            info.kind,
            if writable { &["get", "patch", "update"] } else { &["get"] },
        );
    }
    if entry.has_log {
        sub("log", None, info.kind, &["get"]);
    }
    match (info.group, info.kind) {
        ("", "Pod") => {
            sub("attach", None, "PodAttachOptions", &["create", "get"]);
            sub("eviction", Some(("policy", "v1")), "Eviction", &["create"]);
            sub("exec", None, "PodExecOptions", &["create", "get"]);
        }
        (_, "Lease") => {
            sub("acquire", None, "LeaseRequest", &["create"]);
            sub("return", None, "LeaseRequest", &["create"]);
            sub("take", None, "LeaseRequest", &["create"]);
        }
        (GROUP, "Node") => sub("fence", None, "NodeFence", &["create"]),
        (_, "Framework") => sub("position", None, "FrameworkPosition", &["create"]),
        (_, "TaskSet") => {
            sub("scale", Some(("autoscaling", "v1")), "Scale", &["get", "patch", "update"]);
        }
        _ => {}
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
