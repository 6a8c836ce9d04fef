//! Bodies in Kubernetes' protobuf: kubectl sends some core kinds in it. What is read is what these kinds have here; answers
//! are JSON, which every client takes.

use std::collections::BTreeMap;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use prost::Message;
use serde_json::{Map, Value, json};

use super::failure::Failure;

/// The media type.
pub(super) const PROTOBUF: &str = "application/vnd.kubernetes.protobuf";
/// How an object in protobuf begins.
const MAGIC: &[u8] = b"k8s\0";

/// `runtime.Unknown`: an object and what it is.
#[derive(Clone, PartialEq, Message)]
struct Unknown {
    #[prost(message, optional, tag = "1")]
    kind: Option<TypeMeta>,
    #[prost(bytes = "vec", tag = "2")]
    raw: Vec<u8>,
}

#[derive(Clone, PartialEq, Message)]
struct TypeMeta {
    #[prost(string, tag = "1")]
    api_version: String,
    #[prost(string, tag = "2")]
    kind: String,
}

#[derive(Clone, PartialEq, Message)]
struct ObjectMeta {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(string, tag = "2")]
    generate_name: String,
    #[prost(string, tag = "3")]
    namespace: String,
    #[prost(string, tag = "5")]
    uid: String,
    #[prost(string, tag = "6")]
    resource_version: String,
    #[prost(btree_map = "string, string", tag = "11")]
    labels: BTreeMap<String, String>,
    #[prost(btree_map = "string, string", tag = "12")]
    annotations: BTreeMap<String, String>,
    #[prost(string, repeated, tag = "14")]
    finalizers: Vec<String>,
}

#[derive(Clone, PartialEq, Message)]
struct Namespace {
    #[prost(message, optional, tag = "1")]
    metadata: Option<ObjectMeta>,
}

#[derive(Clone, PartialEq, Message)]
struct ConfigMap {
    #[prost(message, optional, tag = "1")]
    metadata: Option<ObjectMeta>,
    #[prost(btree_map = "string, string", tag = "2")]
    data: BTreeMap<String, String>,
    #[prost(btree_map = "string, bytes", tag = "3")]
    binary_data: BTreeMap<String, Vec<u8>>,
    #[prost(bool, optional, tag = "4")]
    immutable: Option<bool>,
}

#[derive(Clone, PartialEq, Message)]
struct Secret {
    #[prost(message, optional, tag = "1")]
    metadata: Option<ObjectMeta>,
    #[prost(btree_map = "string, bytes", tag = "2")]
    data: BTreeMap<String, Vec<u8>>,
    #[prost(string, tag = "3")]
    r#type: String,
    #[prost(btree_map = "string, string", tag = "4")]
    string_data: BTreeMap<String, String>,
    #[prost(bool, optional, tag = "5")]
    immutable: Option<bool>,
}

#[derive(Clone, PartialEq, Message)]
struct DeleteOptions {
    #[prost(int64, optional, tag = "1")]
    grace_period_seconds: Option<i64>,
    #[prost(message, optional, tag = "2")]
    preconditions: Option<Preconditions>,
    #[prost(string, optional, tag = "4")]
    propagation_policy: Option<String>,
    #[prost(string, repeated, tag = "5")]
    dry_run: Vec<String>,
}

#[derive(Clone, PartialEq, Message)]
struct Preconditions {
    #[prost(string, optional, tag = "1")]
    uid: Option<String>,
    #[prost(string, optional, tag = "2")]
    resource_version: Option<String>,
}

#[derive(Clone, PartialEq, Message)]
struct Eviction {
    #[prost(message, optional, tag = "1")]
    metadata: Option<ObjectMeta>,
    #[prost(message, optional, tag = "2")]
    delete_options: Option<DeleteOptions>,
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

#[derive(Clone, PartialEq, Message)]
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

#[derive(Clone, PartialEq, Message)]
struct OtherAttributes {
    #[prost(string, tag = "1")]
    path: String,
    #[prost(string, tag = "2")]
    verb: String,
}

/// The object as JSON.
pub(super) fn json(bytes: &[u8]) -> Result<Value, Failure> {
    let bad = || Failure::bad_request("the body is not an object in Kubernetes' protobuf");
    let unknown = Unknown::decode(bytes.strip_prefix(MAGIC).ok_or_else(bad)?).map_err(|_| bad())?;
    let kind = unknown.kind.unwrap_or_default();
    let raw = &*unknown.raw;
    let mut object = match kind.kind.as_str() {
        "Namespace" => Namespace::decode(raw).map(|o| json!({"metadata": metadata(o.metadata)})),
        "ConfigMap" => ConfigMap::decode(raw).map(config_map),
        "Secret" => Secret::decode(raw).map(secret),
        "DeleteOptions" => DeleteOptions::decode(raw).map(delete_options),
        "Eviction" => Eviction::decode(raw).map(|o| {
            let options = delete_options(o.delete_options.unwrap_or_default());
            json!({"metadata": metadata(o.metadata), "deleteOptions": options})
        }),
        "SelfSubjectAccessReview" => AccessReview::decode(raw).map(review),
        // Of these nothing is read.
        "SelfSubjectReview" | "SelfSubjectRulesReview" => Ok(json!({})),
        other => {
            let what = format!("application/vnd.kubernetes.protobuf of kind {other:?}");
            return Err(super::body::unsupported(&what, "application/json"));
        }
    }
    .map_err(|_| bad())?;
    object["apiVersion"] = kind.api_version.into();
    object["kind"] = kind.kind.into();
    Ok(object)
}

fn metadata(metadata: Option<ObjectMeta>) -> Value {
    let metadata = metadata.unwrap_or_default();
    let mut fields = Map::new();
    for (field, text) in [
        ("name", metadata.name),
        ("generateName", metadata.generate_name),
        ("namespace", metadata.namespace),
        ("uid", metadata.uid),
        ("resourceVersion", metadata.resource_version),
    ] {
        if !text.is_empty() {
            fields.insert(field.into(), text.into());
        }
    }
    for (field, map) in [("labels", metadata.labels), ("annotations", metadata.annotations)] {
        if !map.is_empty() {
            fields.insert(field.into(), json!(map));
        }
    }
    if !metadata.finalizers.is_empty() {
        fields.insert("finalizers".into(), json!(metadata.finalizers));
    }
    fields.into()
}

fn encoded(map: BTreeMap<String, Vec<u8>>) -> Value {
    map.into_iter()
        .map(|(key, value)| (key, Value::from(STANDARD.encode(value))))
        .collect::<Map<_, _>>()
        .into()
}

/// The fields that say something.
fn with(
    metadata: Option<ObjectMeta>,
    fields: impl IntoIterator<Item = (&'static str, Value)>,
) -> Value {
    let mut object = json!({"metadata": self::metadata(metadata)});
    for (field, value) in fields {
        let says = match &value {
            Value::Null => false,
            Value::Object(members) => !members.is_empty(),
            Value::String(text) => !text.is_empty(),
            _ => true,
        };
        if says {
            object[field] = value;
        }
    }
    object
}

fn config_map(map: ConfigMap) -> Value {
    let immutable = json!(map.immutable);
    let (data, binary) = (json!(map.data), encoded(map.binary_data));
    with(map.metadata, [("data", data), ("binaryData", binary), ("immutable", immutable)])
}

fn secret(secret: Secret) -> Value {
    let immutable = json!(secret.immutable);
    let (data, text) = (encoded(secret.data), json!(secret.string_data));
    let fields = [
        ("data", data),
        ("stringData", text),
        ("type", secret.r#type.into()),
        ("immutable", immutable),
    ];
    with(secret.metadata, fields)
}

fn delete_options(options: DeleteOptions) -> Value {
    let preconditions =
        options.preconditions.map(|p| json!({"uid": p.uid, "resourceVersion": p.resource_version}));
    json!({
        "gracePeriodSeconds": options.grace_period_seconds,
        "propagationPolicy": options.propagation_policy,
        "preconditions": preconditions.unwrap_or_else(|| json!({})),
        "dryRun": options.dry_run,
    })
}

fn review(review: AccessReview) -> Value {
    let spec = review.spec.unwrap_or_default();
    let resource = spec.resource.map(|r| {
        json!({"namespace": r.namespace, "verb": r.verb, "group": r.group,
               "resource": r.resource, "subresource": r.subresource, "name": r.name})
    });
    let other = spec.other.map(|o| json!({"path": o.path, "verb": o.verb}));
    json!({"spec": {"resourceAttributes": resource, "nonResourceAttributes": other}})
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sent(api_version: &str, kind: &str, object: &impl Message) -> Vec<u8> {
        let kind = TypeMeta { api_version: api_version.into(), kind: kind.into() };
        let mut bytes = MAGIC.to_vec();
        let unknown = Unknown { kind: Some(kind), raw: object.encode_to_vec() };
        unknown.encode(&mut bytes).unwrap();
        bytes
    }

    #[test]
    fn kinds_are_read_as_kubectl_sends_them() {
        let metadata = ObjectMeta { name: "x".into(), ..ObjectMeta::default() };
        let secret = Secret {
            metadata: Some(metadata),
            data: [("p".to_owned(), b"q".to_vec())].into(),
            r#type: "Opaque".into(),
            ..Secret::default()
        };
        assert_eq!(
            json(&sent("v1", "Secret", &secret)).unwrap(),
            json!({"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "x"},
                   "data": {"p": "cQ=="}, "type": "Opaque"})
        );
        let resource =
            ResourceAttributes { verb: "create".into(), ..ResourceAttributes::default() };
        let review =
            AccessReview { spec: Some(AccessSpec { resource: Some(resource), other: None }) };
        let read =
            json(&sent("authorization.k8s.io/v1", "SelfSubjectAccessReview", &review)).unwrap();
        assert_eq!(read["spec"]["resourceAttributes"]["verb"], "create");
        assert_eq!(json(&sent("v1", "Pod", &Namespace::default())).unwrap_err().code(), 415);
        assert_eq!(json(b"{}").unwrap_err().code(), 400);
    }
}
