//! Who may do what, and who am I: `SelfSubjectAccessReview`, `SubjectAccessReview`, `SelfSubjectRulesReview`,
//! `SelfSubjectReview`.
//!
//! The answers are those of the one decision that requests are held to.

use http::{Method, StatusCode};
use muster_controller_core::access::{Action, Asked, Verb, decide, rules};
use serde::Deserialize as _;
use serde_json::{Value, json};

use super::path::Object;
use super::registry::Entry;
use super::{Answer, Call, body, failure::Failure, path, registry};
use crate::auth::{self, Asker, Identity};

/// Which question.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Review {
    /// May I do this?
    Access,
    /// May somebody else?
    OfOthers,
    /// What may I do?
    Rules,
    /// Who am I?
    Subject,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct AccessSpec {
    /// Of others.
    user: Option<String>,
    /// Of others.
    groups: Option<Vec<String>>,
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
    let Call { context, asker, request, .. } = call;
    let (parts, body) = request.into_parts();
    let body = body::optional_json(&parts.headers, body).await?;
    let answer = match review {
        Review::Access => {
            let judged = judge(&asker, &spec_of(&body)?)?;
            judged.answer("SelfSubjectAccessReview", &body["spec"])
        }
        Review::OfOthers => {
            let spec = spec_of(&body)?;
            let name = spec.user.clone().unwrap_or_default();
            let groups = spec.groups.clone().unwrap_or_default();
            if name.is_empty() && groups.is_empty() {
                return Err(Failure::bad_request("spec: a user or groups are needed"));
            }
            let other = Asker::with(&context, Identity::known_as(name, groups));
            judge(&other, &spec)?.answer("SubjectAccessReview", &body["spec"])
        }
        Review::Rules => {
            let namespace = body["spec"]["namespace"].as_str().unwrap_or_default();
            told_rules(&asker, namespace)
        }
        Review::Subject => {
            let (username, groups) = (asker.identity.name(), asker.identity.groups());
            json!({
                "kind": "SelfSubjectReview", "apiVersion": "authentication.k8s.io/v1",
                "metadata": {},
                "status": {"userInfo": {"username": username, "groups": groups}},
            })
        }
    };
    Ok(super::json(StatusCode::CREATED, &answer))
}

fn spec_of(body: &Value) -> Result<AccessSpec, Failure> {
    match &body["spec"] {
        Value::Null => Ok(AccessSpec::default()),
        spec => AccessSpec::deserialize(spec)
            .map_err(|error| Failure::bad_request(format!("spec: {error}"))),
    }
}

/// Whether, and why not.
struct Judged {
    allowed: bool,
    reason: String,
}

impl Judged {
    fn answer(self, kind: &str, spec: &Value) -> Value {
        json!({
            "kind": kind, "apiVersion": "authorization.k8s.io/v1", "metadata": {}, "spec": spec,
            "status": {"allowed": self.allowed, "reason": self.reason},
        })
    }
}

/// By the decision that requests are held to.
fn judge(asker: &Asker, spec: &AccessSpec) -> Result<Judged, Failure> {
    match (&spec.resource_attributes, &spec.non_resource_attributes) {
        (Some(asked), None) => Ok(of_resource(asker, asked)),
        (None, Some(asked)) => {
            let uri = asked.path.parse().ok();
            let read = uri.and_then(|uri| path::read(&Method::GET, &uri).ok());
            let judged = match &read {
                Some((verb, target)) if asked.verb == verb.as_str() || asked.verb == "get" => {
                    outcome(asker, &auth::asked(*verb, target))
                }
                _ => nothing(asker, &format!("{} is not served", asked.path)),
            };
            Ok(judged)
        }
        _ => Err(Failure::bad_request(
            "spec: exactly one of resourceAttributes and nonResourceAttributes is needed",
        )),
    }
}

fn of_resource(asker: &Asker, asked: &ResourceAttributes) -> Judged {
    let some = |text: &str| Some(text.to_owned()).filter(|text| !text.is_empty());
    // `*` is every one of them: who may do all that there is may do that.
    let verbs = match asked.verb.as_str() {
        "*" => Verb::ALL.to_vec(),
        word => Verb::named(word).into_iter().collect(),
    };
    let entry = registry::find(&asked.group, &asked.resource);
    let part = entry.and_then(|entry| path::subresource(entry, &asked.subresource));
    let known = asked.subresource.is_empty() || part.is_some();
    let (Some(entry), true, false) = (entry, known, verbs.is_empty()) else {
        return plain(asker, asked, &verbs);
    };
    let object = Object {
        entry,
        namespace: some(&asked.namespace),
        name: some(&asked.name),
        subresource: part,
    };
    let judged = verbs.iter().map(|verb| outcome(asker, &auth::of_object(*verb, &object)));
    all(judged)
}

/// Of what is served and is no kind: tokens, questions, sessions. What is not served at all only administrators may.
fn plain(asker: &Asker, asked: &ResourceAttributes, verbs: &[Verb]) -> Judged {
    let some = |text: &'_ str| (!text.is_empty()).then(|| text.to_owned());
    let (subresource, namespace) = (some(&asked.subresource), some(&asked.namespace));
    let name = some(&asked.name);
    let action = |verb: &Verb| {
        outcome(
            asker,
            &Asked::Right(Action {
                verb: *verb,
                group: &asked.group,
                resource: &asked.resource,
                subresource: subresource.as_deref(),
                namespace: namespace.as_deref(),
                name: name.as_deref(),
            }),
        )
    };
    match verbs.is_empty() {
        true => nothing(asker, &format!("there is no verb {:?}", asked.verb)),
        false => all(verbs.iter().map(action)),
    }
}

fn outcome(asker: &Asker, asked: &Asked<'_>) -> Judged {
    match decide(&asker.who, asked) {
        Ok(()) => Judged { allowed: true, reason: String::new() },
        Err(denied) => Judged { allowed: false, reason: denied.to_string() },
    }
}

fn all(judged: impl Iterator<Item = Judged>) -> Judged {
    let mut judged = judged;
    let denied = judged.find(|judged| !judged.allowed);
    denied.unwrap_or(Judged { allowed: true, reason: String::new() })
}

/// What is not there: who may everything may that too.
fn nothing(asker: &Asker, why: &str) -> Judged {
    let may = rules(&asker.who, "").iter().any(|rule| rule.verbs.is_none());
    Judged { allowed: may, reason: if may { String::new() } else { why.to_owned() } }
}

fn told_rules(asker: &Asker, namespace: &str) -> Value {
    let mut resources = Vec::new();
    let mut others = json!([{"verbs": ["get"], "nonResourceURLs": [
        "/api", "/api/*", "/apis", "/apis/*", "/healthz", "/livez", "/openapi/*", "/readyz", "/version",
    ]}]);
    for rule in rules(&asker.who, namespace) {
        let names: Vec<String> = rule.name.into_iter().collect();
        let Some(verbs) = rule.verbs else {
            resources
                .push(json!({"verbs": ["*"], "apiGroups": ["*"], "resources": [rule.resource]}));
            others = json!([{"verbs": ["*"], "nonResourceURLs": ["*"]}]);
            continue;
        };
        if rule.resource == "metrics" {
            if let Some(list) = others.as_array_mut() {
                list.push(json!({"verbs": ["get"], "nonResourceURLs": ["/metrics"]}));
            }
            continue;
        }
        let verbs: Vec<&str> = verbs.into_iter().map(Verb::as_str).collect();
        resources.push(json!({
            "verbs": verbs, "apiGroups": groups_of(rule.resource), "resources": [rule.resource],
            "resourceNames": names,
        }));
    }
    json!({
        "kind": "SelfSubjectRulesReview", "apiVersion": "authorization.k8s.io/v1",
        "metadata": {}, "spec": {"namespace": namespace},
        "status": {"resourceRules": resources, "nonResourceRules": others, "incomplete": false},
    })
}

/// The groups that have a resource.
fn groups_of(resource: &str) -> Vec<&'static str> {
    let (plural, part) = resource.split_once('/').unwrap_or((resource, ""));
    let has = |entry: &&Entry| part.is_empty() || path::subresource(entry, part).is_some();
    let entries = registry::all().iter().filter(|entry| entry.info.plural == plural).filter(has);
    let groups: Vec<&str> = entries.map(|entry| entry.info.group).collect();
    if groups.is_empty() { vec![muster_api::GROUP] } else { groups }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_answer_is_what_a_request_would_be_told() {
        let dir = tempfile::tempdir().unwrap();
        let context = crate::context::for_tests(dir.path(), crate::store::memory::start().await);
        let may = |asker: &Asker, spec: Value| {
            judge(asker, &AccessSpec::deserialize(&spec).unwrap()).map(|judged| judged.allowed).ok()
        };
        let of = |verb, group, resource, name| json!({"resourceAttributes": {"verb": verb, "group": group, "resource": resource, "name": name}});
        let create = of("create", "muster.dev", "tasks", "");
        let own = of("get", "muster.dev", "nodes", "r1");
        let version = json!({"nonResourceAttributes": {"verb": "get", "path": "/version"}});
        let everything = of("*", "*", "*", "");
        let admin = Asker::admin("a");
        let node = Identity::Node { name: "r1".into(), key: String::new() };
        let node = Asker::with(&context, node);
        assert_eq!(may(&admin, create.clone()), Some(true));
        assert_eq!(may(&admin, everything.clone()), Some(true));
        assert_eq!(may(&node, everything), Some(false));
        assert_eq!(may(&node, create), Some(false));
        assert_eq!(may(&node, own), Some(true));
        assert_eq!(may(&node, version), Some(true));
        assert_eq!(may(&admin, json!({})), None);
    }
}
