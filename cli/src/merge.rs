//! Three-way merge: what the last apply wrote, what the manifest says now, what is stored.
//!
//! A field that the manifest says is set; a field that the last manifest said and this one does not
//! is removed; every other field, set by somebody else or by a default, is left alone. The result is
//! an RFC 7396 merge patch. Lists are values: they are replaced as a whole.

use muster_api::validate::member_path;
use serde_json::{Map, Value};

/// Where an object keeps the manifest that was last applied; the same idea as kubectl's.
pub(crate) const LAST_APPLIED: &str = "muster.dev/last-applied-configuration";

/// The patch that makes `current` what `wanted` says, and removes what only `last` said. An empty
/// object: nothing to do. A null in `wanted` means "as if it were not said": it is removed.
pub(crate) fn three_way(last: Option<&Value>, wanted: &Value, current: &Value) -> Value {
    let none = Map::new();
    let members = |value: Option<&Value>| value.and_then(Value::as_object).cloned();
    let last = members(last);
    Value::Object(merge(
        last.as_ref().unwrap_or(&none),
        wanted.as_object().unwrap_or(&none),
        current.as_object().unwrap_or(&none),
    ))
}

fn merge(
    last: &Map<String, Value>,
    wanted: &Map<String, Value>,
    current: &Map<String, Value>,
) -> Map<String, Value> {
    let mut patch = Map::new();
    for (key, want) in wanted {
        match (want, current.get(key)) {
            (Value::Null, None | Some(Value::Null)) => {}
            (Value::Object(want), Some(Value::Object(current))) => {
                let none = Map::new();
                let last = last.get(key).and_then(Value::as_object).unwrap_or(&none);
                let inner = merge(last, want, current);
                if !inner.is_empty() {
                    patch.insert(key.clone(), Value::Object(inner));
                }
            }
            (want, Some(current)) if want == current => {}
            // A merge patch that creates an object must not carry nulls that were meant as absence.
            (want, _) => {
                patch.insert(key.clone(), without_nulls(want));
            }
        }
    }
    let removed =
        last.keys().filter(|key| !wanted.contains_key(*key) && current.contains_key(*key));
    patch.extend(removed.map(|key| (key.clone(), Value::Null)));
    patch
}

fn without_nulls(value: &Value) -> Value {
    match value {
        Value::Object(members) => members
            .iter()
            .filter(|(_, v)| !v.is_null())
            .map(|(k, v)| (k.clone(), without_nulls(v)))
            .collect::<Map<_, _>>()
            .into(),
        other => other.clone(),
    }
}

/// One field that a merge patch changes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct FieldChange {
    /// `spec.priority`.
    pub(crate) path: String,
    /// The value before; none: it was not there.
    pub(crate) from: Option<Value>,
    /// The value after; none: it is removed.
    pub(crate) to: Option<Value>,
}

/// What a merge patch changes, field by field. The recorded manifest is not a field of its own: it
/// says the same as the others.
pub(crate) fn field_changes(patch: &Value, current: &Value) -> Vec<FieldChange> {
    let mut changes = Vec::new();
    collect("", patch, Some(current), &mut changes);
    changes.retain(|c| c.path != member_path("metadata.annotations", LAST_APPLIED));
    changes
}

fn collect(path: &str, patch: &Value, current: Option<&Value>, changes: &mut Vec<FieldChange>) {
    match (patch, current) {
        (Value::Object(members), Some(Value::Object(_))) => {
            for (key, value) in members {
                let current = current.and_then(|c| c.get(key));
                collect(&member_path(path, key), value, current, changes);
            }
        }
        (Value::Object(members), None) if members.keys().eq([LAST_APPLIED]) => {}
        (to, from) => changes.push(FieldChange {
            path: path.to_owned(),
            from: from.cloned(),
            to: Some(to.clone()).filter(|to| !to.is_null()),
        }),
    }
}

/// The fields of `written` with the values that admission gave them. Admission normalises values
/// (`0.5` cpu becomes `500m`) and fills in defaults; compared with what is stored only the fields
/// that were written may count, but in their normal form. A field that admission dropped because it
/// says the default becomes null.
pub(crate) fn project(written: &Value, admitted: &Value) -> Value {
    match (written, admitted) {
        (Value::Object(written), Value::Object(admitted)) => written
            .iter()
            .map(|(key, value)| {
                let projected = match admitted.get(key) {
                    Some(_) if value.is_null() => Value::Null,
                    Some(normal) => project(value, normal),
                    None => Value::Null,
                };
                (key.clone(), projected)
            })
            .collect::<Map<_, _>>()
            .into(),
        (_, normal) => normal.clone(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    #[test]
    fn only_what_a_manifest_said_is_removed() {
        let last = json!({"spec": {"a": 1, "b": {"x": 1, "y": 2}, "gone": 1}});
        let wanted = json!({"spec": {"a": 2, "b": {"x": 1}, "new": [1]}});
        let current =
            json!({"spec": {"a": 1, "b": {"x": 1, "y": 2, "z": 3}, "other": 4}, "status": {}});
        assert_eq!(
            three_way(Some(&last), &wanted, &current),
            json!({"spec": {"a": 2, "b": {"y": null}, "new": [1]}})
        );
    }

    #[test]
    fn a_patch_is_told_field_by_field() {
        let current = json!({"metadata": {"name": "x"}, "spec": {"a": 1, "b": 2}});
        let patch = json!({"metadata": {"annotations": {LAST_APPLIED: "{}"}}, "spec": {"a": 3, "b": null, "c": {"d": 1}}});
        let change = |path: &str, from: Option<i32>, to: Option<Value>| FieldChange {
            path: path.to_owned(),
            from: from.map(Value::from),
            to,
        };
        assert_eq!(
            field_changes(&patch, &current),
            [
                change("spec.a", Some(1), Some(json!(3))),
                change("spec.b", Some(2), None),
                change("spec.c", None, Some(json!({"d": 1}))),
            ]
        );
        let noted = json!({"metadata": {"annotations": {LAST_APPLIED: "a"}}});
        assert_eq!(
            field_changes(&json!({"metadata": {"annotations": {LAST_APPLIED: "b"}}}), &noted),
            []
        );
    }

    #[test]
    fn without_a_last_manifest_nothing_is_removed() {
        assert_eq!(three_way(None, &json!({"a": 1}), &json!({"a": 1, "b": 2})), json!({}));
    }

    #[test]
    fn values_are_compared_in_their_normal_form_and_defaults_are_left_alone() {
        let written =
            json!({"spec": {"cpu": 0.5, "unschedulable": false, "n": null, "list": [{"a": 1}]}});
        let admitted = json!({"spec": {"cpu": "500m", "priority": 0, "n": 7, "list": [{"a": 1, "op": "Equal"}]}});
        let wanted = project(&written, &admitted);
        assert_eq!(
            wanted,
            json!({"spec": {"cpu": "500m", "unschedulable": null, "n": null, "list": [{"a": 1, "op": "Equal"}]}})
        );
        let current = json!({"spec": {"cpu": "500m", "priority": 9, "unschedulable": true, "list": [{"a": 1, "op": "Equal"}]}});
        assert_eq!(three_way(None, &wanted, &current), json!({"spec": {"unschedulable": null}}));
    }

    /// Trees of objects without nulls; lists and texts as leaves.
    fn tree() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            (0..3_i32).prop_map(Value::from),
            Just(json!([1, 2])),
            Just(json!([])),
            Just(json!({})),
        ];
        leaf.prop_recursive(4, 24, 3, |inner| {
            prop::collection::btree_map("[a-d]", inner, 0..4)
                .prop_map(|m| Value::Object(m.into_iter().collect()))
        })
    }

    fn object() -> impl Strategy<Value = Value> {
        prop::collection::btree_map("[a-d]", tree(), 0..4)
            .prop_map(|m| Value::Object(m.into_iter().collect()))
    }

    /// `whole` says everything that `part` says.
    fn says(whole: &Value, part: &Value) -> bool {
        match (whole, part) {
            (Value::Object(whole), Value::Object(part)) => {
                part.iter().all(|(k, v)| whole.get(k).is_some_and(|w| says(w, v)))
            }
            (whole, part) => whole == part,
        }
    }

    /// The paths of `tree`'s leaves that pass through objects only.
    fn leaves(tree: &Value, path: &mut Vec<String>, out: &mut Vec<Vec<String>>) {
        match tree {
            Value::Object(members) if !members.is_empty() => {
                for (key, value) in members {
                    path.push(key.clone());
                    leaves(value, path, out);
                    path.pop();
                }
            }
            _ => out.push(path.clone()),
        }
    }

    fn at<'a>(tree: &'a Value, path: &[String]) -> Option<&'a Value> {
        path.iter().try_fold(tree, |value, key| value.get(key))
    }

    proptest! {
        #[test]
        fn what_is_wanted_holds_afterwards_and_again_means_nothing_to_do(
            last in object(), wanted in object(), current in object(),
        ) {
            let patch = three_way(Some(&last), &wanted, &current);
            let mut after = current;
            json_patch::merge(&mut after, &patch);
            prop_assert!(says(&after, &wanted), "{after} lacks something of {wanted}");
            prop_assert_eq!(three_way(Some(&wanted), &wanted, &after), json!({}));
        }

        #[test]
        fn what_only_the_last_manifest_said_is_gone_and_what_nobody_said_stays(
            last in object(), wanted in object(), current in object(),
        ) {
            let patch = three_way(Some(&last), &wanted, &current);
            let mut after = current.clone();
            json_patch::merge(&mut after, &patch);
            let mut paths = Vec::new();
            leaves(&current, &mut Vec::new(), &mut paths);
            for path in paths.iter().filter(|p| !p.is_empty()) {
                // Whether a manifest said this field or something on the way to it.
                let said = |manifest: &Value| (1..=path.len()).any(|n| at(manifest, &path[..n]).is_some_and(|v| n == path.len() || !v.is_object()));
                let before = at(&current, path);
                let dropped = (1..=path.len()).any(|n| at(&last, &path[..n]).is_some() && at(&wanted, &path[..n]).is_none());
                let kept = !said(&wanted) && !dropped && (1..path.len()).all(|n| at(&wanted, &path[..n]).is_none_or(Value::is_object));
                if kept {
                    prop_assert_eq!(at(&after, path), before, "{:?}", path);
                }
                if dropped && at(&wanted, &path[..1]).is_none() {
                    prop_assert_eq!(at(&after, path), None, "{:?}", path);
                }
            }
        }
    }
}
