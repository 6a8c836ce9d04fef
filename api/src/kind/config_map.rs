//! ConfigMap: core `v1`, as Kubernetes has it: settings that tasks get as environment and files.

use std::collections::BTreeMap;

pub use k8s_openapi::api::core::v1::ConfigMap;
use serde_json::Value;

use super::KindInfo;
use super::keyed::{self, Form};
use crate::validate::{Violations, member_path};

/// The values of a stored ConfigMap by key, text and binary alike; none: it does not read as one.
#[must_use]
pub fn values(object: &Value) -> Option<BTreeMap<String, Vec<u8>>> {
    let mut values = BTreeMap::new();
    for (key, value) in object.get("data").and_then(Value::as_object).into_iter().flatten() {
        values.insert(key.clone(), value.as_str()?.as_bytes().to_vec());
    }
    for (key, value) in object.get("binaryData").and_then(Value::as_object).into_iter().flatten() {
        values.insert(key.clone(), keyed::decode(value)?);
    }
    Some(values)
}

fn admit(object: &mut Value, violations: &mut Violations) {
    keyed::check_fields(object, &["data", "binaryData", "immutable"], violations);
    keyed::check_immutable(object, violations);
    let bytes = keyed::check_map(object, "data", Form::Text, violations)
        + keyed::check_map(object, "binaryData", Form::Base64, violations);
    keyed::check_size(bytes, "data", violations);
    let has = |field: &str, key: &String| object[field].get(key).is_some();
    for key in object["data"].as_object().into_iter().flat_map(|data| data.keys()) {
        if has("binaryData", key) {
            violations.duplicate(member_path("binaryData", key), "is in data, too");
        }
    }
}

pub(super) const INFO: KindInfo = KindInfo {
    group: "",
    version: "v1",
    kind: "ConfigMap",
    plural: "configmaps",
    singular: "configmap",
    short_names: &["cm"],
    namespaced: true,
    has_status: false,
    schema: |g| g.subschema_for::<ConfigMap>(),
    selectable: &[],
    admit_body: admit,
    admit_change: |old, new, violations| {
        keyed::check_frozen(old, new, &["data", "binaryData"], violations);
    },
};

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::kind;

    fn object(fields: Value) -> Value {
        let mut object =
            json!({"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "settings"}});
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
    fn text_and_binary_values_stand_under_keys() {
        let good =
            object(json!({"data": {"a.txt": "x", "gone": null}, "binaryData": {"b": "AP8="}}));
        let admitted = kind::admit(&good).expect("good");
        assert_eq!(admitted["data"], json!({"a.txt": "x"}));
        let values = values(&admitted).expect("it reads");
        assert_eq!(values["a.txt"], b"x");
        assert_eq!(values["b"], [0, 255]);
        assert_eq!(kind::admit(&admitted), Ok(admitted.clone()), "admission is idempotent");
    }

    #[test]
    fn what_is_wrong_is_named_by_key() {
        assert_eq!(
            problems(json!({
                "data": {"a b": "x", "n": 5, "twice": ""}, "binaryData": {"twice": "AA==", "no": "*"},
                "immutable": "yes", "spec": {}, "dta": {},
            })),
            [
                "dta: is not a field; did you mean \"data\"?",
                "spec: is not a field; a ConfigMap has data, binaryData, immutable",
                "immutable: is neither true nor false",
                "data[\"a b\"]: a key is made of letters, digits, '-', '_' and '.'",
                "data.n: is not a text; put it in quotes",
                "binaryData.no: is not base64; a text belongs under data",
                "binaryData.twice: is in data, too",
            ]
        );
        let big = "x".repeat(keyed::MAX_BYTES + 1);
        assert_eq!(
            problems(json!({"data": {"a": big}})),
            ["data: 1048577 bytes in all are more than the most allowed, 1048576"]
        );
    }

    #[test]
    fn immutable_is_for_ever() {
        let frozen = object(json!({"data": {"a": "1"}, "immutable": true}));
        let change = |new: &Value| match kind::admit_change(&INFO, &frozen, new) {
            Ok(()) => Vec::new(),
            Err(found) => found.iter().map(|v| v.path.clone()).collect(),
        };
        assert_eq!(change(&object(json!({"data": {"a": "2"}, "immutable": true}))), ["data"]);
        assert_eq!(change(&object(json!({"data": {"a": "1"}}))), ["immutable"]);
        assert!(change(&frozen).is_empty());
        let open = object(json!({"data": {"a": "1"}}));
        kind::admit_change(&INFO, &open, &frozen).expect("it may become immutable");
    }
}
