//! What may I do, and who am I: `SelfSubjectAccessReview`, `SelfSubjectRulesReview`, `SelfSubjectReview`.
//!
//! kubectl sends these in protobuf; of that only what they say of the question is read.

use http::{HeaderMap, Method, StatusCode};
use prost::Message;
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

const PROTOBUF: &str = "application/vnd.kubernetes.protobuf";
/// How an object in protobuf begins.
const MAGIC: &[u8] = b"k8s\0";

/// `runtime.Unknown`: an object and what it is.
#[derive(Clone, PartialEq, Message)]
struct Unknown {
    #[prost(bytes = "vec", optional, tag = "2")]
    raw: Option<Vec<u8>>,
}

#[derive(Clone, PartialEq, Message)]
struct AccessReview {
    #[prost(message, optional, tag = "2")]
    spec: Option<AccessSpec>,
}

#[derive(Clone, PartialEq, Message)]
struct AccessSpec {
    #[prost(message, optional, tag = "1")]
    resource: Option<ResourceAttributes>,
    #[prost(message, optional, tag = "2")]
    other: Option<OtherAttributes>,
}

#[derive(Clone, PartialEq, Message, serde::Deserialize)]
#[serde(default)]
struct ResourceAttributes {
    #[prost(string, tag = "1")]
    namespace: String,
    #[prost(string, tag = "2")]
    verb: String,
    #[prost(string, tag = "3")]
    group: String,
    #[prost(string, tag = "5")]
    resource: String,
    #[prost(string, tag = "6")]
    subresource: String,
    #[prost(string, tag = "7")]
    name: String,
}

#[derive(Clone, PartialEq, Message, serde::Deserialize)]
#[serde(default)]
struct OtherAttributes {
    #[prost(string, tag = "1")]
    path: String,
    #[prost(string, tag = "2")]
    verb: String,
}

pub(super) async fn answer(call: Call, review: Review) -> Answer {
    let Call { identity, request, .. } = call;
    let (parts, body) = request.into_parts();
    let bytes = body::bytes(body).await?;
    let answer = match review {
        Review::Access => {
            let spec = access(&parts.headers, &bytes)?;
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

/// The question in either form.
fn access(headers: &HeaderMap, bytes: &[u8]) -> Result<AccessSpec, Failure> {
    let media = body::media_type(headers);
    if media == PROTOBUF {
        let bad = || Failure::bad_request("the body is not a SelfSubjectAccessReview in protobuf");
        let unknown = bytes.strip_prefix(MAGIC).ok_or_else(bad)?;
        let raw = Unknown::decode(unknown).map_err(|_| bad())?.raw.unwrap_or_default();
        let review = AccessReview::decode(&*raw).map_err(|_| bad())?;
        return Ok(review.spec.unwrap_or_default());
    }
    if !matches!(media.as_str(), "" | "application/json") {
        return Err(body::unsupported(&media, &format!("application/json, {PROTOBUF}")));
    }
    let review = body::parse(bytes)?;
    let spec = &review["spec"];
    let read = |error: serde_json::Error| Failure::bad_request(format!("spec: {error}"));
    let optional = |value: &Value| (!value.is_null()).then(|| value.clone());
    Ok(AccessSpec {
        resource: optional(&spec["resourceAttributes"])
            .map(serde_json::from_value)
            .transpose()
            .map_err(read)?,
        other: optional(&spec["nonResourceAttributes"])
            .map(serde_json::from_value)
            .transpose()
            .map_err(read)?,
    })
}

/// Whether they may, by the rules that requests are held to; and the question as it was understood.
fn may(identity: &Identity, spec: &AccessSpec) -> Result<(bool, Value), Failure> {
    let all = matches!(identity, Identity::Admin { .. });
    match (&spec.resource, &spec.other) {
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
    fn a_question_in_protobuf_is_read() {
        let resource = ResourceAttributes {
            verb: "create".into(),
            group: "muster.dev".into(),
            resource: "tasks".into(),
            ..ResourceAttributes::default()
        };
        let spec = AccessSpec { resource: Some(resource), other: None };
        let raw = AccessReview { spec: Some(spec.clone()) }.encode_to_vec();
        let mut bytes = MAGIC.to_vec();
        Unknown { raw: Some(raw) }.encode(&mut bytes).unwrap();
        let headers =
            HeaderMap::from_iter([(http::header::CONTENT_TYPE, PROTOBUF.parse().unwrap())]);
        assert_eq!(access(&headers, &bytes).unwrap(), spec);
        assert!(access(&headers, b"{}").is_err());
        let admin = Identity::Admin { name: "a".into() };
        assert!(may(&admin, &spec).unwrap().0);
        let user = Identity::User { name: "u".into(), groups: Vec::new() };
        assert!(!may(&user, &spec).unwrap().0);
    }
}
