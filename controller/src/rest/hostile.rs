//! What clients send that only this module reads, fed with what a stranger may send: see `muster-hostile`.

use std::path::Path;

use bytes::Bytes;
use http::Uri;
use serde_json::{Value, json};

use super::path::Object;
use super::query::Query;
use super::registry::Entry;
use super::selector::Selection;
use super::{body, owners, patch, protobuf, registry};
use crate::objects::{NODES, TASKS};
use crate::store::{DEEPEST, is_deeper};

/// An answer that says what is wrong with the request, not with the server.
fn blames_the_client(failure: &super::failure::Failure) {
    assert!((400..500).contains(&failure.code()), "{}: {}", failure.code(), failure.message());
    assert!(!failure.message().is_empty());
}

#[test]
fn patches_are_applied_or_refused() {
    let present = json!({
        "apiVersion": "muster.dev/v1alpha1", "kind": "Task",
        "metadata": {"name": "t", "labels": {"a": "b"}, "finalizers": ["a", "b"], "resourceVersion": "7",
            "ownerReferences": [{"uid": "u", "kind": "TaskSet"}]},
        "spec": {"priority": 1, "run": {"process": {"command": ["true"], "args": ["x"]}}},
    });
    let inputs = muster_hostile::inputs("patches");
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let bytes = Bytes::copy_from_slice(bytes);
        for media in [patch::MERGE, patch::STRATEGIC, patch::JSON] {
            let applied =
                patch::read(media, &bytes).and_then(|patch| patch::apply(&patch, &present));
            match applied {
                // A merge is as deep as the patch, which was read; operations could go on for ever.
                Ok(object) if media == patch::JSON => assert!(!is_deeper(&object, DEEPEST)),
                Ok(object) => drop(object.to_string()),
                Err(failure) => blames_the_client(&failure),
            }
        }
    });
}

fn by(name: &str) -> owners::Writer {
    let time = "2026-01-01T00:00:00Z".to_owned();
    owners::Writer { name: name.to_owned(), subresource: "", view: None, time }
}

/// What is applied on the server: whoever says the same once more changes nothing, and neither does who says the same as another.
#[test]
fn applications_are_taken_whole_or_refused() {
    let entry = registry::of(TASKS).expect("it is served");
    let manifests = Path::new(env!("CARGO_MANIFEST_DIR")).join("../manifests/examples");
    let inputs = muster_hostile::inputs("apply").and_those_in(&manifests);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let bytes = Bytes::copy_from_slice(bytes);
        let target = target(entry, &bytes);
        let config = match patch::configuration(entry, &target, &bytes) {
            Ok(config) => config,
            Err(failure) => return blames_the_client(&failure),
        };
        let apply =
            |live: &Value, name: &str| owners::applied(entry, live, &config, &by(name), false);
        let first = match apply(&Value::Null, "first") {
            Ok(first) => first,
            Err(failure) => return blames_the_client(&failure),
        };
        assert_eq!(apply(&first, "first").expect("it is theirs"), first);
        let both = apply(&first, "second").expect("they agree");
        assert_eq!(without_owners(&both), without_owners(&first));
    });
}

fn without_owners(object: &Value) -> Value {
    let mut object = object.clone();
    object["metadata"]["managedFields"] = Value::Null;
    object
}

/// The object that the path has: the one that the bytes name, if they name one.
fn target(entry: &'static Entry, bytes: &[u8]) -> Object {
    let text = String::from_utf8_lossy(bytes);
    let named: Value = serde_saphyr::from_str(&text).unwrap_or_default();
    let text = |field: &str, other: &str| {
        Some(named["metadata"][field].as_str().unwrap_or(other).to_owned())
    };
    let (name, namespace) = (text("name", "t"), text("namespace", "default"));
    Object { entry, namespace, name, subresource: None }
}

/// Trees of fields, as a client may send them back.
#[test]
fn owners_are_read_as_they_are_written() {
    let inputs = muster_hostile::inputs("apply");
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let Ok(list) = body::parse(bytes) else { return };
        let read = |list: &Value| owners::of(&json!({"metadata": {"managedFields": list}}));
        if let Some(owners) = read(&list) {
            assert_eq!(read(&owners::write(&owners)), Some(owners));
        }
    });
}

/// A field of protobuf's that holds bytes.
fn field(tag: u8, bytes: &[u8]) -> Vec<u8> {
    let length = u8::try_from(bytes.len()).expect("a short field");
    assert!(length < 128);
    [&[tag << 3 | 2, length], bytes].concat()
}

/// An object in Kubernetes' protobuf: `k8s\0`, what it is, and its fields.
fn object(kind: &str, fields: &[u8]) -> Vec<u8> {
    let meaning = [field(1, b"v1"), field(2, kind.as_bytes())].concat();
    [&b"k8s\0"[..], &field(1, &meaning), &field(2, fields)].concat()
}

#[test]
fn objects_in_protobuf_are_read_or_refused() {
    let metadata = field(
        1,
        &[field(1, b"lab"), field(11, &[field(1, b"a"), field(2, b"b")].concat())].concat(),
    );
    let data =
        [metadata.clone(), field(2, &[field(1, b"key"), field(2, b"value")].concat())].concat();
    let seeds = [
        object("Namespace", &metadata),
        object("ConfigMap", &data),
        object("Secret", &data),
        object("DeleteOptions", &[0x08, 30]),
        object("Eviction", &metadata),
        object("SelfSubjectAccessReview", &field(2, &field(1, &field(2, b"get")))),
    ];
    let inputs = muster_hostile::inputs("headers").and(seeds);
    muster_hostile::feed(bolero::check!(), inputs, |bytes| match protobuf::json(bytes) {
        Ok(object) => assert_eq!(body::parse(object.to_string().as_bytes()).unwrap(), object),
        Err(failure) => blames_the_client(&failure),
    });
}

#[test]
fn queries_are_understood_or_refused() {
    let inputs = muster_hostile::inputs("patches");
    muster_hostile::feed(bolero::check!(), inputs, |bytes| {
        let Ok(uri) = format!("/x?{}", String::from_utf8_lossy(bytes)).parse::<Uri>() else {
            return;
        };
        let query = match Query::read(&uri) {
            Ok(query) => query,
            Err(failure) => return blames_the_client(&failure),
        };
        let refused = [
            query.lasts().map(drop),
            query.dry_run().map(drop),
            query.field_validation().map(drop),
            query.revision().map(drop),
            query.parse::<usize>("limit").map(drop),
        ];
        let entries = [TASKS, NODES].map(|resource| registry::of(resource).expect("it is served"));
        let selections =
            entries.map(|entry| Selection::read(entry, Some("default"), &query).map(drop));
        refused
            .iter()
            .chain(&selections)
            .filter_map(|read| read.as_ref().err())
            .for_each(blames_the_client);
    });
}
