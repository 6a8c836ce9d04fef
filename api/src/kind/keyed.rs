//! What ConfigMap and Secret have in common: values under keys beside `metadata`, no `spec` and no `status`.
//!
//! Every check here is made on the JSON, field by field, and says where something is wrong and never what
//! stands there: a Secret's value must not come back in an error.

use serde_json::{Map, Value};

use crate::validate::{Violations, did_you_mean, member_path};

/// Longest key, characters; keys are names of files.
const MAX_KEY: usize = 253;
/// Most bytes of all values of one object together, after base64.
pub const MAX_BYTES: usize = 1 << 20;

/// What stands in an object of base64: the bytes; none: it is not base64.
pub(super) fn decode(value: &Value) -> Option<Vec<u8>> {
    use k8s_openapi::ByteString;
    serde_json::from_value::<ByteString>(value.clone()).ok().map(|bytes| bytes.0)
}

/// Bytes as they stand in an object.
pub(super) fn encode(bytes: Vec<u8>) -> Value {
    serde_json::to_value(k8s_openapi::ByteString(bytes)).expect("base64 is a text")
}

/// Fields of the object that its kind does not have.
pub(super) fn check_fields(object: &Value, own: &[&str], violations: &mut Violations) {
    let known: Vec<&str> = ["apiVersion", "kind", "metadata"].iter().chain(own).copied().collect();
    for key in object.as_object().into_iter().flat_map(Map::keys) {
        if !known.contains(&key.as_str()) {
            violations.not_supported(member_path("", key), "is not a field").suggestion =
                did_you_mean(key, known.iter().copied()).or_else(|| {
                    Some(format!(
                        "a {} has {}",
                        object["kind"].as_str().unwrap_or("map"),
                        own.join(", ")
                    ))
                });
        }
    }
}

/// What a member of a map of values must be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// Any text.
    Text,
    /// A text of base64.
    Base64,
}

/// Checks the map of values `field`, and removes nulls and the map itself when it is empty. Returns how many bytes
/// it holds.
pub(super) fn check_map(
    object: &mut Value,
    field: &str,
    form: Form,
    violations: &mut Violations,
) -> usize {
    let Some(members) = object.as_object_mut() else { return 0 };
    match members.get_mut(field) {
        None => return 0,
        Some(Value::Null) => {
            members.remove(field);
            return 0;
        }
        Some(Value::Object(map)) => map.retain(|_, value| !value.is_null()),
        Some(_) => {
            violations.invalid(field, "is not a map of keys and values");
            return 0;
        }
    }
    let map = members.get(field).and_then(Value::as_object).cloned().unwrap_or_default();
    if map.is_empty() {
        members.remove(field);
    }
    let mut bytes = 0;
    for (key, value) in &map {
        let path = member_path(field, key);
        if let Err(reason) = check_key(key) {
            violations.invalid(path.clone(), reason);
        }
        match (value, form) {
            (Value::String(text), Form::Text) => bytes += text.len(),
            (Value::String(_), Form::Base64) => match decode(value) {
                Some(decoded) => bytes += decoded.len(),
                None => {
                    let hint = if field == "data" {
                        "give the text itself under stringData"
                    } else {
                        "a text belongs under data"
                    };
                    violations.invalid(path, "is not base64").suggest(hint);
                }
            },
            (_, _) => {
                violations.invalid(path, "is not a text").suggest("put it in quotes");
            }
        }
    }
    bytes
}

/// All values together are small enough to be held in memory and sent to every node that needs them.
pub(super) fn check_size(bytes: usize, field: &str, violations: &mut Violations) {
    if bytes > MAX_BYTES {
        violations.invalid(
            field,
            format!("{bytes} bytes in all are more than the most allowed, {MAX_BYTES}"),
        );
    }
}

/// Checks `immutable`.
pub(super) fn check_immutable(object: &mut Value, violations: &mut Violations) {
    let Some(members) = object.as_object_mut() else { return };
    match members.get("immutable") {
        None | Some(Value::Bool(_)) => {}
        Some(Value::Null) => drop(members.remove("immutable")),
        Some(_) => drop(violations.invalid("immutable", "is neither true nor false")),
    }
}

/// What of an object that is `immutable` changed.
pub(super) fn check_frozen(old: &Value, new: &Value, fields: &[&str], violations: &mut Violations) {
    if old.get("immutable") != Some(&Value::Bool(true)) {
        return;
    }
    let again = "delete it and create it again, or use another name";
    if new.get("immutable") != Some(&Value::Bool(true)) {
        violations
            .forbidden("immutable", "cannot be taken back while the object exists")
            .suggest(again);
    }
    for field in fields.iter().filter(|field| old.get(**field) != new.get(**field)) {
        violations.forbidden(*field, "cannot change: the object is immutable").suggest(again);
    }
}

/// Whether a key can be the name of a file, as Kubernetes wants it.
///
/// # Errors
///
/// What is wrong with it.
pub fn check_key(key: &str) -> Result<(), &'static str> {
    if key.is_empty() || key.len() > MAX_KEY {
        return Err("a key has 1 to 253 characters");
    }
    if key == "." || key == ".." || key.starts_with("..") {
        return Err("a key may not be \".\" or begin with \"..\"");
    }
    if !key.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._".contains(&b)) {
        return Err("a key is made of letters, digits, '-', '_' and '.'");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys() {
        for good in ["a", "app.yaml", "A_b-C.1", ".hidden", &"k".repeat(253)] {
            assert_eq!(check_key(good), Ok(()), "{good}");
        }
        for bad in ["", ".", "..", "..a", "a/b", "a b", "ü", &"k".repeat(254)] {
            assert!(check_key(bad).is_err(), "{bad}");
        }
    }
}
