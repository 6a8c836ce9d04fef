//! Secret: core `v1`, as Kubernetes has it: passwords and keys that tasks get as environment and files.
//!
//! `stringData` is merged into `data` here, so it is never stored or given back. What is stored is sealed before it
//! reaches the disk (`controller::store::seal`).

use std::collections::BTreeMap;

pub use k8s_openapi::api::core::v1::Secret;
use serde_json::{Value, json};

use super::KindInfo;
use super::keyed::{self, Form};
use crate::validate::{Violations, member_path};

/// The type of a Secret that names none.
pub const OPAQUE: &str = "Opaque";

/// Keys that must be there, by type.
const REQUIRED: [(&str, &[&str]); 4] = [
    ("kubernetes.io/ssh-auth", &["ssh-privatekey"]),
    ("kubernetes.io/tls", &["tls.crt", "tls.key"]),
    (DOCKER_JSON, &[".dockerconfigjson"]),
    ("kubernetes.io/dockercfg", &[".dockercfg"]),
];
const BASIC_AUTH: &str = "kubernetes.io/basic-auth";
const DOCKER_JSON: &str = "kubernetes.io/dockerconfigjson";

/// The values of a stored Secret by key; none: it does not read as one.
#[must_use]
pub fn values(object: &Value) -> Option<BTreeMap<String, Vec<u8>>> {
    let data = object.get("data").and_then(Value::as_object).into_iter().flatten();
    data.map(|(key, value)| Some((key.clone(), keyed::decode(value)?))).collect()
}

/// Moves `stringData` into `data`; what was under the same key before is replaced. Nothing is done where a field has
/// not its form: admission says so.
pub fn merge_string_data(object: &mut Value) {
    let Some(fields) = object.as_object_mut() else { return };
    if !fields.get("data").is_none_or(|data| data.is_object() || data.is_null()) {
        return;
    }
    let texts = match fields.get("stringData") {
        Some(Value::Object(texts)) if texts.values().all(|v| v.is_string() || v.is_null()) => {
            texts.clone()
        }
        Some(Value::Null) => serde_json::Map::new(),
        _ => return,
    };
    fields.remove("stringData");
    let encoded = texts.iter().filter_map(|(key, value)| {
        Some((key.clone(), keyed::encode(value.as_str()?.as_bytes().to_vec())))
    });
    if let data @ Value::Null = fields.entry("data").or_insert(Value::Null) {
        *data = json!({});
    }
    if let Some(data) = fields.get_mut("data").and_then(Value::as_object_mut) {
        data.extend(encoded);
    }
}

fn admit(object: &mut Value, violations: &mut Violations) {
    keyed::check_fields(object, &["data", "stringData", "type", "immutable"], violations);
    keyed::check_immutable(object, violations);
    keyed::check_map(object, "stringData", Form::Text, violations);
    merge_string_data(object);
    let bytes = keyed::check_map(object, "data", Form::Base64, violations);
    keyed::check_size(bytes, "data", violations);
    let Some(fields) = object.as_object_mut() else { return };
    match fields.get("type") {
        None | Some(Value::Null) => drop(fields.insert("type".to_owned(), OPAQUE.into())),
        Some(Value::String(word)) if word.is_empty() => {
            fields.insert("type".to_owned(), OPAQUE.into());
        }
        Some(Value::String(_)) => {}
        Some(_) => {
            violations.invalid("type", "is not a text");
            return;
        }
    }
    check_type(object, violations);
}

fn check_type(object: &Value, violations: &mut Violations) {
    let kind = object["type"].as_str().unwrap_or_default();
    let has = |key: &str| object["data"].get(key).is_some();
    let wanted = REQUIRED.iter().find(|(name, _)| *name == kind).map_or(&[][..], |(_, keys)| keys);
    for key in wanted.iter().filter(|key| !has(key)) {
        violations
            .required(member_path("data", key))
            .suggest(format!("a Secret of type {kind} has it"));
    }
    if kind == BASIC_AUTH && !has("username") && !has("password") {
        violations
            .required("data.username")
            .suggest(format!("a Secret of type {kind} has a username, a password, or both"));
    }
    if kind == DOCKER_JSON
        && let Some(text) = object["data"].get(".dockerconfigjson").and_then(keyed::decode)
        && serde_json::from_slice::<Value>(&text).is_err()
    {
        violations.invalid("data[\".dockerconfigjson\"]", "is not JSON");
    }
}

fn admit_change(old: &Value, new: &Value, violations: &mut Violations) {
    keyed::check_frozen(old, new, &["data"], violations);
    if old.get("type") != new.get("type") {
        violations
            .forbidden("type", "cannot change while the object exists")
            .suggest("delete it and create it again");
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: "",
    version: "v1",
    kind: "Secret",
    plural: "secrets",
    singular: "secret",
    short_names: &[],
    namespaced: true,
    has_status: false,
    schema: |g| g.subschema_for::<Secret>(),
    selectable: &["type"],
    admit_body: admit,
    admit_change,
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kind;

    fn object(fields: Value) -> Value {
        let mut object = json!({"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "key"}});
        object.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
        object
    }

    fn problems(fields: Value) -> Vec<String> {
        match kind::admit(&object(fields)) {
            Ok(_) => Vec::new(),
            Err(found) => found.iter().map(ToString::to_string).collect(),
        }
    }

    #[test]
    fn string_data_goes_into_data_and_nowhere_else() {
        let given = object(json!({"data": {"a": "b2xk", "b": "eA=="}, "stringData": {"a": "new"}}));
        let admitted = kind::admit(&given).expect("good");
        assert_eq!(admitted["data"], json!({"a": "bmV3", "b": "eA=="}));
        assert_eq!(admitted["type"], OPAQUE);
        assert!(admitted.get("stringData").is_none());
        assert_eq!(values(&admitted).expect("it reads")["a"], b"new");
        assert_eq!(kind::admit(&admitted), Ok(admitted.clone()), "admission is idempotent");
    }

    #[test]
    fn types_have_their_keys() {
        let of = |kind: &str, data: Value| problems(json!({"type": kind, "stringData": data}));
        assert!(of("kubernetes.io/basic-auth", json!({"password": "x"})).is_empty());
        assert!(of("example.org/mine", json!({})).is_empty());
        assert_eq!(of("kubernetes.io/basic-auth", json!({})).len(), 1);
        assert_eq!(of("kubernetes.io/tls", json!({})).len(), 2);
        assert_eq!(of("kubernetes.io/ssh-auth", json!({})).len(), 1);
        assert_eq!(
            of("kubernetes.io/dockerconfigjson", json!({".dockerconfigjson": "{"})),
            ["data[\".dockerconfigjson\"]: is not JSON"]
        );
    }

    #[test]
    fn errors_name_the_key_and_not_the_value() {
        let found = problems(json!({
            "data": {"a": "hunter2!"}, "stringData": {"b": 424_242, "c d": "hunter2"}, "type": 7,
        }));
        assert_eq!(found.len(), 4, "{found:?}");
        assert!(
            !found.concat().contains("hunter2") && !found.concat().contains("424242"),
            "{found:?}"
        );
    }

    #[test]
    fn its_type_never_changes() {
        let old = kind::admit(&object(json!({}))).expect("good");
        let new = object(json!({"type": "other"}));
        let found = kind::admit_change(&INFO, &old, &new).expect_err("another type");
        assert_eq!(found.iter().map(|v| v.path.as_str()).collect::<Vec<_>>(), ["type"]);
    }
}
