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
    #[prost(int64, optional, tag = "7")]
    generation: Option<i64>,
    #[prost(message, optional, tag = "8")]
    creation_timestamp: Option<Time>,
    #[prost(message, optional, tag = "9")]
    deletion_timestamp: Option<Time>,
    #[prost(int64, optional, tag = "10")]
    deletion_grace_period_seconds: Option<i64>,
    #[prost(btree_map = "string, string", tag = "11")]
    labels: BTreeMap<String, String>,
    #[prost(btree_map = "string, string", tag = "12")]
    annotations: BTreeMap<String, String>,
    #[prost(message, repeated, tag = "13")]
    owner_references: Vec<OwnerReference>,
    #[prost(string, repeated, tag = "14")]
    finalizers: Vec<String>,
    #[prost(message, repeated, tag = "17")]
    managed_fields: Vec<ManagedFieldsEntry>,
}

#[derive(Clone, PartialEq, Message)]
struct Time {
    #[prost(int64, tag = "1")]
    seconds: i64,
}

#[derive(Clone, PartialEq, Message)]
struct OwnerReference {
    #[prost(string, tag = "1")]
    kind: String,
    #[prost(string, tag = "3")]
    name: String,
    #[prost(string, tag = "4")]
    uid: String,
    #[prost(string, tag = "5")]
    api_version: String,
    #[prost(bool, optional, tag = "6")]
    controller: Option<bool>,
    #[prost(bool, optional, tag = "7")]
    block_owner_deletion: Option<bool>,
}

#[derive(Clone, PartialEq, Message)]
struct ManagedFieldsEntry {
    #[prost(string, tag = "1")]
    manager: String,
    #[prost(string, tag = "2")]
    operation: String,
    #[prost(string, tag = "3")]
    api_version: String,
    #[prost(message, optional, tag = "4")]
    time: Option<Time>,
    #[prost(string, tag = "6")]
    fields_type: String,
    #[prost(message, optional, tag = "7")]
    fields_v1: Option<FieldsV1>,
    #[prost(string, tag = "8")]
    subresource: String,
}

#[derive(Clone, PartialEq, Message)]
struct FieldsV1 {
    #[prost(bytes = "vec", tag = "1")]
    raw: Vec<u8>,
}

#[derive(Clone, PartialEq, Message)]
struct Namespace {
    #[prost(message, optional, tag = "1")]
    metadata: Option<ObjectMeta>,
    #[prost(message, optional, tag = "2")]
    spec: Option<NamespaceSpec>,
}

#[derive(Clone, PartialEq, Message)]
struct NamespaceSpec {
    #[prost(string, repeated, tag = "1")]
    finalizers: Vec<String>,
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
    /// This and the next of a review of others.
    #[prost(string, tag = "3")]
    user: String,
    #[prost(string, repeated, tag = "4")]
    groups: Vec<String>,
}

#[derive(Clone, PartialEq, Message)]
struct RulesReview {
    #[prost(message, optional, tag = "2")]
    spec: Option<RulesSpec>,
}

#[derive(Clone, PartialEq, Message)]
struct RulesSpec {
    #[prost(string, tag = "1")]
    namespace: String,
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
        "Namespace" => Namespace::decode(raw).map(namespace),
        "ConfigMap" => ConfigMap::decode(raw).map(config_map),
        "Secret" => Secret::decode(raw).map(secret),
        "DeleteOptions" => DeleteOptions::decode(raw).map(delete_options),
        "Eviction" => Eviction::decode(raw).map(|o| {
            let options = delete_options(o.delete_options.unwrap_or_default());
            json!({"metadata": metadata(o.metadata), "deleteOptions": options})
        }),
        "SelfSubjectAccessReview" | "SubjectAccessReview" => AccessReview::decode(raw).map(review),
        "SelfSubjectRulesReview" => RulesReview::decode(raw).map(
            |review| json!({"spec": {"namespace": review.spec.unwrap_or_default().namespace}}),
        ),
        // Of this nothing is read.
        "SelfSubjectReview" => Ok(json!({})),
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
    for (field, number) in [
        ("generation", metadata.generation),
        ("deletionGracePeriodSeconds", metadata.deletion_grace_period_seconds),
    ] {
        // Generations begin with 1; a grace of nothing is one.
        if let Some(number) = number.filter(|number| *number != 0 || field != "generation") {
            fields.insert(field.into(), number.into());
        }
    }
    for (field, time) in [
        ("creationTimestamp", metadata.creation_timestamp),
        ("deletionTimestamp", metadata.deletion_timestamp),
    ] {
        if let Some(time) = time.and_then(rfc3339) {
            fields.insert(field.into(), time.into());
        }
    }
    if !metadata.finalizers.is_empty() {
        fields.insert("finalizers".into(), json!(metadata.finalizers));
    }
    let owners: Vec<Value> = metadata.owner_references.into_iter().map(owner).collect();
    let managed: Vec<Value> = metadata.managed_fields.into_iter().map(managed).collect();
    for (field, list) in [("ownerReferences", owners), ("managedFields", managed)] {
        if !list.is_empty() {
            fields.insert(field.into(), list.into());
        }
    }
    fields.into()
}

/// None: a time that there is not, as that of an object that is not created yet.
fn rfc3339(time: Time) -> Option<String> {
    let at = jiff::Timestamp::from_second(time.seconds).ok()?;
    (time.seconds > 0).then(|| at.strftime("%Y-%m-%dT%H:%M:%SZ").to_string())
}

/// The members that say something.
fn saying(members: impl IntoIterator<Item = (&'static str, Value)>) -> Value {
    let says = |value: &Value| !value.is_null() && value != "";
    let members = members.into_iter().filter(|(_, value)| says(value));
    members.map(|(name, value)| (name.to_owned(), value)).collect::<Map<_, _>>().into()
}

fn owner(owner: OwnerReference) -> Value {
    saying([
        ("apiVersion", owner.api_version.into()),
        ("kind", owner.kind.into()),
        ("name", owner.name.into()),
        ("uid", owner.uid.into()),
        ("controller", json!(owner.controller)),
        ("blockOwnerDeletion", json!(owner.block_owner_deletion)),
    ])
}

fn managed(entry: ManagedFieldsEntry) -> Value {
    let fields = entry.fields_v1.and_then(|fields| serde_json::from_slice(&fields.raw).ok());
    saying([
        ("manager", entry.manager.into()),
        ("operation", entry.operation.into()),
        ("apiVersion", entry.api_version.into()),
        ("time", json!(entry.time.and_then(rfc3339))),
        ("fieldsType", entry.fields_type.into()),
        ("fieldsV1", fields.unwrap_or_default()),
        ("subresource", entry.subresource.into()),
    ])
}

fn namespace(namespace: Namespace) -> Value {
    let mut object = json!({"metadata": metadata(namespace.metadata)});
    let finalizers = namespace.spec.map(|spec| spec.finalizers).unwrap_or_default();
    if !finalizers.is_empty() {
        object["spec"] = json!({"finalizers": finalizers});
    }
    object
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
    let mut review =
        json!({"spec": {"resourceAttributes": resource, "nonResourceAttributes": other}});
    if !spec.user.is_empty() || !spec.groups.is_empty() {
        review["spec"]["user"] = spec.user.into();
        review["spec"]["groups"] = spec.groups.into();
    }
    review
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
        let metadata = ObjectMeta {
            name: "x".into(),
            creation_timestamp: Some(Time { seconds: 1_700_000_000 }),
            owner_references: vec![OwnerReference {
                kind: "TaskSet".into(),
                name: "watch".into(),
                uid: "u".into(),
                api_version: "muster.dev/v1alpha1".into(),
                controller: Some(true),
                block_owner_deletion: Some(false),
            }],
            managed_fields: vec![ManagedFieldsEntry {
                manager: "kubectl".into(),
                operation: "Apply".into(),
                api_version: "v1".into(),
                time: Some(Time { seconds: 1_700_000_000 }),
                fields_type: "FieldsV1".into(),
                fields_v1: Some(FieldsV1 { raw: br#"{"f:data":{}}"#.to_vec() }),
                subresource: String::new(),
            }],
            ..ObjectMeta::default()
        };
        let map = ConfigMap { metadata: Some(metadata), ..ConfigMap::default() };
        assert_eq!(
            json(&sent("v1", "ConfigMap", &map)).unwrap()["metadata"],
            json!({
                "name": "x", "creationTimestamp": "2023-11-14T22:13:20Z",
                "ownerReferences": [{"apiVersion": "muster.dev/v1alpha1", "kind": "TaskSet",
                    "name": "watch", "uid": "u", "controller": true, "blockOwnerDeletion": false}],
                "managedFields": [{"manager": "kubectl", "operation": "Apply", "apiVersion": "v1",
                    "time": "2023-11-14T22:13:20Z", "fieldsType": "FieldsV1", "fieldsV1": {"f:data": {}}}],
            })
        );
        let resource =
            ResourceAttributes { verb: "create".into(), ..ResourceAttributes::default() };
        let review = AccessReview {
            spec: Some(AccessSpec { resource: Some(resource), ..AccessSpec::default() }),
        };
        let read =
            json(&sent("authorization.k8s.io/v1", "SelfSubjectAccessReview", &review)).unwrap();
        assert_eq!(read["spec"]["resourceAttributes"]["verb"], "create");
        let review = RulesReview { spec: Some(RulesSpec { namespace: "lab".into() }) };
        let read =
            json(&sent("authorization.k8s.io/v1", "SelfSubjectRulesReview", &review)).unwrap();
        assert_eq!(read["spec"]["namespace"], "lab");
        assert_eq!(json(&sent("v1", "Pod", &Namespace::default())).unwrap_err().code(), 415);
        assert_eq!(json(b"{}").unwrap_err().code(), 400);
    }
}
