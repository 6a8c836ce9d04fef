//! Strategic merge patches, for core kinds: a merge patch with directives.
//!
//! Of the lists in what is written through core kinds here, only those of `metadata` are merged; the others are replaced
//! whole, as in Kubernetes (taints are such a list).

use serde_json::{Map, Value};

use super::failure::Failure;

/// Changes `target` by `patch`.
pub(super) fn merge(target: &mut Value, patch: &Value) -> Result<(), Failure> {
    let Some(patch) = patch.as_object() else {
        return Err(Failure::bad_request("a strategic merge patch is a JSON object"));
    };
    fields(target, patch)
}

fn fields(target: &mut Value, patch: &Map<String, Value>) -> Result<(), Failure> {
    match patch.get("$patch").map(Value::as_str) {
        None => {}
        Some(Some("replace" | "delete")) => *target = Value::Object(Map::new()),
        Some(Some("merge")) => {}
        Some(other) => {
            let other = other.unwrap_or("what is no text");
            return Err(Failure::bad_request(format!(
                "$patch: {other} is not replace, merge or delete"
            )));
        }
    }
    if !target.is_object() {
        *target = Value::Object(Map::new());
    }
    let Some(members) = target.as_object_mut() else { return Ok(()) };
    if let Some(kept) = patch.get("$retainKeys").and_then(Value::as_array) {
        members.retain(|name, _| kept.iter().any(|kept| kept == name));
    }
    for (name, value) in patch {
        if let Some(list) = name.strip_prefix("$deleteFromPrimitiveList/") {
            if let (Some(Value::Array(present)), Value::Array(gone)) =
                (members.get_mut(list), value)
            {
                present.retain(|element| !gone.contains(element));
            }
            continue;
        }
        match value {
            // Orders of merged lists, and what was followed above.
            _ if name.starts_with('$') => {}
            Value::Null => drop(members.remove(name)),
            Value::Object(inner) if inner.get("$patch").is_some_and(|p| p == "delete") => {
                members.remove(name);
            }
            Value::Object(inner) => fields(members.entry(name).or_insert(Value::Null), inner)?,
            Value::Array(said) => {
                let present = members.entry(name).or_insert_with(|| Value::Array(Vec::new()));
                *present = Value::Array(list(name, present.as_array(), said));
            }
            other => drop(members.insert(name.clone(), other.clone())),
        }
    }
    Ok(())
}

fn list(name: &str, present: Option<&Vec<Value>>, said: &[Value]) -> Vec<Value> {
    let mut merged = match name {
        "finalizers" | "ownerReferences" => present.cloned().unwrap_or_default(),
        _ => Vec::new(),
    };
    for element in said {
        let same = |other: &Value| match name {
            "ownerReferences" => other["uid"] == element["uid"],
            _ => other == element,
        };
        match name {
            "finalizers" | "ownerReferences" => merged.retain(|other| !same(other)),
            _ => {}
        }
        if element.get("$patch").is_none() {
            merged.push(element.clone());
        }
    }
    merged
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn directives_are_followed() {
        let mut object = json!({
            "metadata": {"labels": {"a": "1", "b": "2"}, "finalizers": ["x", "y"], "ownerReferences": [{"uid": "1"}, {"uid": "2"}]},
            "spec": {"taints": [{"key": "k"}], "unschedulable": true, "other": {"a": 1}},
        });
        let patch = json!({
            "metadata": {
                "labels": {"a": null, "c": "3"},
                "$setElementOrder/finalizers": ["y", "z"],
                "$deleteFromPrimitiveList/finalizers": ["x"], "finalizers": ["z"],
                "ownerReferences": [{"$patch": "delete", "uid": "1"}],
            },
            "spec": {"taints": [{"key": "new"}], "unschedulable": null, "other": {"$patch": "replace", "b": 2}},
        });
        merge(&mut object, &patch).unwrap();
        assert_eq!(
            object,
            json!({
                "metadata": {"labels": {"b": "2", "c": "3"}, "finalizers": ["y", "z"], "ownerReferences": [{"uid": "2"}]},
                "spec": {"taints": [{"key": "new"}], "other": {"b": 2}},
            })
        );
        assert!(merge(&mut object, &json!({"spec": {"$patch": "swap"}})).is_err());
    }
}
