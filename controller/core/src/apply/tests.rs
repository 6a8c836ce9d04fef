use proptest::prelude::*;
use serde_json::{Value, json};

use super::path::{read, write};
use super::{Application, Conflict, Manager, Operation, Owned, Owners, all_of, apply, update};

fn schema() -> Value {
    json!({"type": "object", "properties": {
        "metadata": {"properties": {"labels": {"additionalProperties": {"type": "string"}}}},
        "spec": {"properties": {
            "replicas": {"type": "integer"},
            "command": {"type": "array", "items": {"type": "string"}},
            "sensors": {"type": "array", "x-kubernetes-list-type": "set"},
            "env": {"type": "array", "x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["name"],
                    "items": {"anyOf": [{"properties": {"name": {}, "value": {}}}, {"type": "null"}]}},
        }},
    }})
}

fn manager(name: &str, operation: Operation) -> Manager {
    Manager { name: name.into(), operation, subresource: String::new(), version: "v1".into() }
}

fn applied(
    live: &Value,
    owners: &Owners,
    name: &str,
    config: &Value,
    force: bool,
) -> Result<(Value, Owners), Vec<Conflict>> {
    let manager = manager(name, Operation::Apply);
    apply(&schema(), live, owners, Application { manager: &manager, config, force, time: "t" })
}

fn fields(owners: &Owners, name: &str, operation: Operation) -> Value {
    owners.get(&manager(name, operation)).map_or(Value::Null, |owned| write(&owned.fields))
}

#[test]
fn a_map_of_nothing_but_nulls_is_an_empty_one() {
    let config = json!({"spec": {"replicas": null}});
    let (object, owners) = applied(&json!({}), &Owners::new(), "a", &config, false).unwrap();
    assert_eq!(object, json!({"spec": {}}));
    assert_eq!(fields(&owners, "a", Operation::Apply), json!({"f:spec": {}}));
    let others = json!({"spec": {}});
    let (same, owners) = applied(&object, &owners, "b", &others, false).expect("they agree");
    let (gone, _) = applied(&same, &owners, "b", &json!({}), false).unwrap();
    assert_eq!((same, gone), (object.clone(), object), "it is a's still");
}

#[test]
fn fields_are_written_as_kubernetes_writes_them() {
    let config = json!({
        "metadata": {"labels": {"app": "x"}},
        "spec": {"replicas": 2, "command": ["a", "b"], "sensors": ["k:L"], "env": [{"name": "A", "value": "1"}]},
    });
    let (object, owners) = applied(&json!({}), &Owners::new(), "a", &config, false).unwrap();
    assert_eq!(object, config);
    let written = fields(&owners, "a", Operation::Apply);
    assert_eq!(
        written,
        json!({
            "f:metadata": {"f:labels": {"f:app": {}}},
            "f:spec": {
                "f:replicas": {}, "f:command": {}, "f:sensors": {"v:\"k:L\"": {}},
                "f:env": {"k:{\"name\":\"A\"}": {".": {}, "f:name": {}, "f:value": {}}},
            },
        })
    );
    assert_eq!(write(&read(&written)), written);
}

#[test]
fn what_is_not_applied_any_more_goes_unless_another_has_it() {
    let first = json!({"metadata": {"labels": {"a": "1", "b": "2"}},
        "spec": {"sensors": ["x", "y"], "env": [{"name": "A", "value": "1"}, {"name": "B", "value": "2"}]}});
    let (live, owners) = applied(&json!({}), &Owners::new(), "one", &first, false).unwrap();
    let second = json!({"metadata": {"labels": {"b": "2"}}, "spec": {"env": [{"name": "B"}]}});
    let (live, owners) = applied(&live, &owners, "two", &second, false).unwrap();
    let less = json!({"spec": {"sensors": ["y"]}});
    let (live, owners) = applied(&live, &owners, "one", &less, false).unwrap();
    assert_eq!(
        live,
        json!({"metadata": {"labels": {"b": "2"}}, "spec": {"sensors": ["y"], "env": [{"name": "B"}]}})
    );
    let nothing = json!({});
    let (live, owners) = applied(&live, &owners, "two", &nothing, false).unwrap();
    assert_eq!(live, json!({"spec": {"sensors": ["y"]}}), "what is left empty goes as well");
    assert!(!owners.contains_key(&manager("two", Operation::Apply)));
}

#[test]
fn a_field_of_another_is_a_conflict_unless_the_value_is_the_same_or_it_is_forced() {
    let (live, owners) =
        applied(&json!({}), &Owners::new(), "one", &json!({"spec": {"replicas": 2}}), false)
            .unwrap();
    applied(&live, &owners, "two", &json!({"spec": {"replicas": 2}}), false)
        .expect("the same value");
    let other = json!({"spec": {"replicas": 3, "env": [{"name": "A", "value": "1"}]}});
    let conflicts = applied(&live, &owners, "two", &other, false).expect_err("another value");
    assert_eq!(conflicts.len(), 1);
    assert_eq!(conflicts[0].path.to_string(), ".spec.replicas");
    assert_eq!(conflicts[0].manager.name, "one");
    let (live, owners) = applied(&live, &owners, "two", &other, true).unwrap();
    assert_eq!(live, other);
    assert_eq!(fields(&owners, "one", Operation::Apply), Value::Null, "it lost what it had");
}

#[test]
fn an_update_takes_what_it_changes() {
    let config = json!({"spec": {"replicas": 2, "env": [{"name": "A", "value": "1"}]}});
    let (live, owners) = applied(&json!({}), &Owners::new(), "one", &config, false).unwrap();
    let new = json!({"spec": {"replicas": 5, "env": []}});
    let scaler = manager("scale", Operation::Update);
    let owners = update(&schema(), &live, &new, &owners, (&scaler, "later"));
    assert_eq!(fields(&owners, "one", Operation::Apply), Value::Null);
    assert_eq!(
        fields(&owners, "scale", Operation::Update),
        json!({"f:spec": {"f:replicas": {}, "f:env": {}}})
    );
    let conflicts = applied(&new, &owners, "one", &config, false).expect_err("it is the scaler's");
    assert_eq!(conflicts[0].path.to_string(), ".spec.replicas");
}

#[test]
fn lists_that_do_not_keep_to_their_keys_are_taken_whole() {
    let twice =
        json!({"spec": {"env": [{"name": "A", "value": "1"}, {"name": "A", "value": "2"}]}});
    let (live, owners) = applied(&json!({}), &Owners::new(), "one", &twice, false).unwrap();
    assert_eq!(live, twice);
    assert_eq!(fields(&owners, "one", Operation::Apply), json!({"f:spec": {"f:env": {}}}));
}

fn part() -> impl Strategy<Value = Value> {
    let label = proptest::collection::btree_map("[ab]", "[12]", 0..3);
    let env = proptest::collection::btree_map("[AB]", "[12]", 0..3);
    let sensors = proptest::collection::btree_set("[xy]", 0..3);
    (label, env, sensors, proptest::option::of(0..3_u8)).prop_map(
        |(labels, env, sensors, replicas)| {
            let env: Vec<Value> =
                env.into_iter().map(|(n, v)| json!({"name": n, "value": v})).collect();
            let mut spec = json!({"env": env, "sensors": sensors});
            if let Some(replicas) = replicas {
                spec["replicas"] = replicas.into();
            }
            json!({"metadata": {"labels": labels}, "spec": spec})
        },
    )
}

proptest! {
    /// Whatever was applied before: what is applied last, with force, is so; what others mean and it does not touch,
    /// stays; and applying the same again changes nothing.
    #[test]
    fn what_was_applied_is_so_until_it_is_withdrawn(steps in proptest::collection::vec((0..3_usize, part()), 1..8)) {
        let names = ["a", "b", "c"];
        let (mut live, mut owners) = (json!({}), Owners::new());
        for (who, config) in &steps {
            (live, owners) = applied(&live, &owners, names[*who], config, true).unwrap();
            let schema = schema();
            let said = super::shape::leaves(&schema, config);
            let has = super::shape::leaves(&schema, &live);
            for (path, value) in &said {
                // An empty list or map that others fill is not empty.
                let empty = value.is_some_and(|v| *v == json!([]) || *v == json!({}));
                prop_assert!(empty || has.get(path) == Some(value), "{path} of {config} in {live}");
            }
            for (manager, owned) in &owners {
                for path in &owned.fields {
                    let there = has.keys().any(|p| p.starts_with(path));
                    let emptied = has.keys().any(|p| path.starts_with(p));
                    prop_assert!(there || emptied || path.steps().len() == 2, "{manager:?} has {path}, {live} has not");
                }
            }
            let again = applied(&live, &owners, names[*who], config, false).unwrap();
            prop_assert_eq!(&again, &(live.clone(), owners.clone()));
        }
        // All withdraw: nothing is left.
        for name in names {
            (live, owners) = applied(&live, &owners, name, &json!({}), false).unwrap();
        }
        prop_assert!(owners.is_empty());
        prop_assert!(all_of(&schema(), &live).iter().all(|p| p.steps().len() <= 2), "{live}");
    }
}

#[test]
fn what_was_there_before_is_one_managers() {
    let live = json!({"spec": {"replicas": 1}});
    let owned = Owned { fields: all_of(&schema(), &live), time: String::new() };
    let owners = Owners::from([(manager("before-first-apply", Operation::Update), owned)]);
    let conflicts = applied(&live, &owners, "kubectl", &json!({"spec": {"replicas": 2}}), false)
        .expect_err("held");
    assert_eq!(conflicts[0].manager.name, "before-first-apply");
}

#[test]
fn long_lists_take_no_longer_than_their_length() {
    // Compared pairwise, these would take minutes.
    const LONG: usize = 20_000;
    let object = |from: usize| {
        let env: Vec<Value> = (from..from + LONG)
            .map(|n| json!({"name": format!("N{n}"), "value": n.to_string()}))
            .collect();
        let sensors: Vec<String> = (from..from + LONG).map(|n| format!("s:{n}")).collect();
        json!({"spec": {"env": env, "sensors": sensors}})
    };
    let (live, owners) = applied(&json!({}), &Owners::new(), "one", &object(0), false).unwrap();
    let (live, owners) = applied(&live, &owners, "two", &object(LONG / 2), false).unwrap();
    assert_eq!(live["spec"]["env"].as_array().map(Vec::len), Some(LONG * 3 / 2));
    let (live, owners) = applied(&live, &owners, "one", &json!({}), false).unwrap();
    assert_eq!(live, object(LONG / 2), "what another has as well stays");
    let scaler = manager("scale", Operation::Update);
    let owners = update(&schema(), &live, &object(LONG), &owners, (&scaler, "later"));
    assert!(owners.contains_key(&scaler));
}
