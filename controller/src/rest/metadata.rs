//! The fields of `metadata` that belong to the server.

use serde_json::{Map, Value};

use crate::context::Context;

/// Never taken from a client as they are; whose each field is, is said in its own place (`owners`).
const IGNORED: [&str; 2] = ["managedFields", "selfLink"];
/// Set once by the server, or only by a deletion.
const KEPT: [&str; 5] =
    ["uid", "creationTimestamp", "generation", "deletionTimestamp", "deletionGracePeriodSeconds"];

/// `metadata` of an object, made when it is missing.
pub(super) fn of(object: &mut Value) -> Option<&mut Map<String, Value>> {
    let object = object.as_object_mut()?;
    let metadata = object.entry("metadata").or_insert_with(|| Value::Object(Map::new()));
    if metadata.is_null() {
        *metadata = Value::Object(Map::new());
    }
    metadata.as_object_mut()
}

/// A text of `metadata` that is there and not empty.
pub(super) fn text<'a>(object: &'a Value, field: &str) -> Option<&'a str> {
    object["metadata"][field].as_str().filter(|text| !text.is_empty())
}

/// Gives a new object what the server owns.
pub(super) fn begin(context: &Context, metadata: &mut Map<String, Value>, counts: bool) {
    for field in IGNORED.iter().chain(&KEPT).chain(&["resourceVersion"]) {
        metadata.remove(*field);
    }
    metadata.insert("uid".into(), uuid::Uuid::new_v4().to_string().into());
    metadata.insert("creationTimestamp".into(), context.stamp().into());
    if counts {
        metadata.insert("generation".into(), 1.into());
    }
}

/// Gives a changed object what the server owns, from the object before it.
pub(super) fn carry(old: &Value, metadata: &mut Map<String, Value>) {
    for field in IGNORED {
        metadata.remove(field);
    }
    for field in KEPT.iter().chain(&["name", "namespace", "resourceVersion"]) {
        match old["metadata"].get(*field) {
            Some(value) => metadata.insert((*field).into(), value.clone()),
            None => metadata.remove(*field),
        };
    }
}

/// Counts a change of what the object is meant to be.
pub(super) fn count(old: &Value, new: &mut Value) {
    let Some(generation) = old["metadata"]["generation"].as_u64() else { return };
    let meant = |object: &Value| {
        let fields = object.as_object().into_iter().flatten();
        let meant = fields.filter(|(field, _)| !matches!(field.as_str(), "metadata" | "status"));
        meant.map(|(field, value)| (field.clone(), value.clone())).collect::<Map<_, _>>()
    };
    if meant(old) != meant(new) {
        new["metadata"]["generation"] = (generation + 1).into();
    }
}

/// Whether the object waits to be removed.
pub(super) fn is_ending(object: &Value) -> bool {
    !object["metadata"]["deletionTimestamp"].is_null()
}

/// Whether somebody still has something to do before the object may go.
pub(super) fn has_finalizers(object: &Value) -> bool {
    object["metadata"]["finalizers"].as_array().is_some_and(|list| !list.is_empty())
}
