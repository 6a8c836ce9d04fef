//! What may I do, and who am I: `SelfSubjectAccessReview`, `SelfSubjectRulesReview`, `SelfSubjectReview`.
//!
//! The answers are those of the one function that requests are held to.

use http::{Method, StatusCode};
use serde::Deserialize as _;
use serde_json::{Value, json};

use super::path::{Object, Target, Verb};
use super::{Answer, Call, body, failure::Failure, registry};
use crate::auth::{Identity, Permission, permits};

/// Which question.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Review {
    /// May I do this?
    Access,
    /// What may I do?
    Rules,
    /// Who am I?
    Subject,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct AccessSpec {
    resource_attributes: Option<ResourceAttributes>,
    non_resource_attributes: Option<OtherAttributes>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(default)]
struct ResourceAttributes {
    namespace: String,
    verb: String,
    group: String,
    resource: String,
    subresource: String,
    name: String,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(default)]
struct OtherAttributes {
    path: String,
    verb: String,
}

pub(super) async fn answer(call: Call, review: Review) -> Answer {
    let Call { identity, request, .. } = call;
    let (parts, body) = request.into_parts();
    let body = body::optional_json(&parts.headers, body).await?;
    let answer = match review {
        Review::Access => {
            let spec = match &body["spec"] {
                Value::Null => AccessSpec::default(),
                spec => AccessSpec::deserialize(spec)
                    .map_err(|error| Failure::bad_request(format!("spec: {error}")))?,
            };
            let (allowed, asked) = may(&identity, &spec)?;
            json!({
                "kind": "SelfSubjectAccessReview", "apiVersion": "authorization.k8s.io/v1",
                "metadata": {}, "spec": asked, "status": {"allowed": allowed},
            })
        }
        Review::Rules => rules(&identity),
        Review::Subject => {
            let groups: Vec<String> = identity.groups();
            json!({
                "kind": "SelfSubjectReview", "apiVersion": "authentication.k8s.io/v1",
                "metadata": {},
                "status": {"userInfo": {"username": identity.name(), "groups": groups}},
            })
        }
    };
    Ok(super::json(StatusCode::CREATED, &answer))
}

/// Whether they may, by the rules that requests are held to; and the question as it was understood.
fn may(identity: &Identity, spec: &AccessSpec) -> Result<(bool, Value), Failure> {
    let all = matches!(identity, Identity::Admin { .. });
    match (&spec.resource_attributes, &spec.non_resource_attributes) {
        (Some(asked), None) => {
            let verb = Verb::named(&asked.verb);
            let entry = registry::find(&asked.group, &asked.resource);
            let target = entry.map(|entry| {
                let some = |text: &str| Some(text.to_owned()).filter(|text| !text.is_empty());
                Target::Objects(Object {
                    entry,
                    namespace: some(&asked.namespace),
                    name: some(&asked.name),
                    subresource: None,
                })
            });
            // Of a subresource nobody but an admin has been given anything that is not the object's, too.
            let granted = match (verb, target) {
                (Some(verb), Some(target)) if asked.subresource.is_empty() => {
                    permits(identity, verb, &target) == Permission::Granted
                }
                _ => all,
            };
            let shown = json!({"resourceAttributes": {
                "namespace": asked.namespace, "verb": asked.verb, "group": asked.group,
                "resource": asked.resource, "subresource": asked.subresource, "name": asked.name,
            }});
            Ok((granted, shown))
        }
        (None, Some(asked)) => {
            let uri = asked.path.parse().ok();
            let read = uri.and_then(|uri| super::path::read(&Method::GET, &uri).ok());
            let granted = read.is_some_and(|(verb, target)| {
                permits(identity, verb, &target) == Permission::Granted
            });
            let shown = json!({"nonResourceAttributes": {"path": asked.path, "verb": asked.verb}});
            Ok((all || granted && asked.verb == "get", shown))
        }
        _ => Err(Failure::bad_request(
            "spec: exactly one of resourceAttributes and nonResourceAttributes is needed",
        )),
    }
}

fn rules(identity: &Identity) -> Value {
    let (resources, others) = match identity {
        Identity::Admin { .. } => (
            json!([{"verbs": ["*"], "apiGroups": ["*"], "resources": ["*"]}]),
            json!([{"verbs": ["*"], "nonResourceURLs": ["*"]}]),
        ),
        Identity::Node { name, .. } => (
            json!([{"verbs": ["get"], "apiGroups": [muster_api::GROUP, ""], "resources": ["nodes"], "resourceNames": [name]}]),
            json!([{"verbs": ["get"], "nonResourceURLs": ["/api", "/apis", "/version", "/healthz"]}]),
        ),
        _ => (
            json!([]),
            json!([{"verbs": ["get"], "nonResourceURLs": ["/api", "/apis", "/version", "/healthz"]}]),
        ),
    };
    json!({
        "kind": "SelfSubjectRulesReview", "apiVersion": "authorization.k8s.io/v1",
        "metadata": {}, "spec": {},
        "status": {"resourceRules": resources, "nonResourceRules": others, "incomplete": false},
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_answer_is_what_a_request_would_be_told() {
        let may = |identity: &Identity, spec: Value| {
            may(identity, &AccessSpec::deserialize(&spec).unwrap()).map(|(allowed, _)| allowed).ok()
        };
        let create = json!({"resourceAttributes": {"verb": "create", "group": "muster.dev", "resource": "tasks"}});
        let own = json!({"resourceAttributes": {"verb": "get", "group": "muster.dev", "resource": "nodes", "name": "r1"}});
        let version = json!({"nonResourceAttributes": {"verb": "get", "path": "/version"}});
        let admin = Identity::Admin { name: "a".into() };
        let node = Identity::Node { name: "r1".into(), key: String::new() };
        assert_eq!(may(&admin, create.clone()), Some(true));
        assert_eq!(may(&node, create), Some(false));
        assert_eq!(may(&node, own), Some(true));
        assert_eq!(may(&node, version), Some(true));
        assert_eq!(may(&admin, json!({})), None);
    }
}
