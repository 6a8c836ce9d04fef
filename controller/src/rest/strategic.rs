//! Strategic merge patches, for core kinds: a merge patch with directives.
//!
//! Of the lists in what is written through core kinds here, only those of `metadata` are merged; the others are replaced
//! whole, as in Kubernetes (taints are such a list).

use std::collections::{BTreeMap, BTreeSet};

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
        let kept: BTreeSet<&str> = kept.iter().filter_map(Value::as_str).collect();
        members.retain(|name, _| kept.contains(name.as_str()));
    }
    for (name, value) in patch {
        if let Some(list) = name.strip_prefix("$deleteFromPrimitiveList/") {
            if let (Some(Value::Array(present)), Value::Array(gone)) =
                (members.get_mut(list), value)
            {
                let gone = values(gone);
                present.retain(|element| !gone.contains(&element.to_string()));
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

/// A list that is merged: by uid, or by value. The last word about an element counts.
fn list(name: &str, present: Option<&Vec<Value>>, said: &[Value]) -> Vec<Value> {
    let key = |element: &Value| match name {
        "ownerReferences" => element["uid"].to_string(),
        _ => element.to_string(),
    };
    let stays = |element: &Value| element.get("$patch").is_none();
    if !matches!(name, "finalizers" | "ownerReferences") {
        return said.iter().filter(|element| stays(element)).cloned().collect();
    }
    let last: BTreeMap<String, usize> =
        said.iter().enumerate().map(|(place, element)| (key(element), place)).collect();
    let kept = present.into_iter().flatten().filter(|element| !last.contains_key(&key(element)));
    let new = said.iter().enumerate();
    let new = new.filter(|(place, element)| last.get(&key(element)) == Some(place));
    kept.chain(new.map(|(_, element)| element).filter(|element| stays(element))).cloned().collect()
}

/// The values, to be looked up.
fn values(list: &[Value]) -> BTreeSet<String> {
    list.iter().map(ToString::to_string).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    /// As the words say it: each element of the patch takes the place of those that are the same.
    fn one_by_one(present: &[Value], said: &[Value]) -> Vec<Value> {
        let mut merged = present.to_vec();
        for element in said {
            merged.retain(|other| other["uid"] != element["uid"]);
            if element.get("$patch").is_none() {
                merged.push(element.clone());
            }
        }
        merged
    }

    proptest! {
        #[test]
        fn a_merged_list_is_as_if_merged_one_by_one(
            present in prop::collection::vec((0..6_u8, 0..3_u8), 0..8),
            said in prop::collection::vec((0..6_u8, 0..3_u8, any::<bool>()), 0..8),
        ) {
            let owner = |uid: u8, name: u8| json!({"uid": uid.to_string(), "name": name});
            let present: Vec<Value> = present.into_iter().map(|(uid, n)| owner(uid, n)).collect();
            let said: Vec<Value> = said.into_iter().map(|(uid, n, gone)| {
                let mut element = owner(uid, n);
                if gone {
                    element["$patch"] = "delete".into();
                }
                element
            }).collect();
            let merged = list("ownerReferences", Some(&present), &said);
            prop_assert_eq!(merged, one_by_one(&present, &said));
        }
    }

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
