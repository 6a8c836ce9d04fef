//! Values as their schema has them: structures and maps by field, lists by key, sets by value; everything else whole.
//!
//! The schema is a JSON schema without references. Lists say what they are by `x-kubernetes-list-type` and
//! `x-kubernetes-list-map-keys`. Where there is no schema, as under `data` of a work, maps go by key and lists whole.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use serde_json::{Map, Value};

use super::path::{Path, Step};

/// The leaves of a value by path. Elements of lists with keys are leaves as well, without a value: that they are there
/// is something to own.
pub type Leaves<'a> = BTreeMap<Path, Option<&'a Value>>;

/// How a value is taken apart.
enum Shape<'s> {
    /// By field, each with its own schema.
    Fields(&'s Value),
    /// A list whose elements are found by the values of these fields.
    Keyed(Vec<&'s str>, &'s Value),
    /// A list of different values.
    Set,
    /// Not at all.
    Whole,
}

/// A map in which there is nothing.
static NOTHING: LazyLock<Value> = LazyLock::new(|| Value::Object(Map::new()));

/// Nothing is known.
const NO_SCHEMA: &Value = &Value::Null;

/// The schema of an optional field without its "or null" branch.
fn without_null(schema: &Value) -> &Value {
    let Some(branches) = schema.get("anyOf").and_then(Value::as_array) else { return schema };
    let mut real = branches.iter().filter(|branch| branch["type"] != "null");
    match (real.next(), real.next()) {
        (Some(only), None) => without_null(only),
        _ => NO_SCHEMA,
    }
}

fn shape<'s>(schema: &'s Value, value: &Value) -> Shape<'s> {
    match value {
        Value::Object(_) if schema["x-kubernetes-map-type"] == "atomic" => Shape::Whole,
        Value::Object(_) => Shape::Fields(schema),
        Value::Array(elements) => list(schema, elements),
        _ => Shape::Whole,
    }
}

fn list<'s>(schema: &'s Value, elements: &[Value]) -> Shape<'s> {
    match schema["x-kubernetes-list-type"].as_str() {
        Some("set") if all_different(elements.iter().map(ToString::to_string)) => Shape::Set,
        Some("map") => {
            let keys = schema["x-kubernetes-list-map-keys"].as_array();
            let keys: Vec<&str> = keys.into_iter().flatten().filter_map(Value::as_str).collect();
            let items = without_null(schema.get("items").unwrap_or(NO_SCHEMA));
            let named = |element: &Value| keys.iter().any(|key| element.get(*key).is_some());
            let steps = elements.iter().map(|element| step(&keys, element));
            // A list that does not keep to its keys cannot be taken apart.
            if elements.iter().all(named) && all_different(steps) {
                Shape::Keyed(keys, items)
            } else {
                Shape::Whole
            }
        }
        _ => Shape::Whole,
    }
}

fn all_different<T: Ord>(items: impl Iterator<Item = T>) -> bool {
    let mut seen = BTreeSet::new();
    items.into_iter().all(|item| seen.insert(item))
}

/// The step to an element of a list with keys.
fn step(keys: &[&str], element: &Value) -> Step {
    Step::key(keys.iter().filter_map(|key| Some((*key, element.get(*key)?))))
}

/// The schema of a field of a structure or a map.
fn field<'s>(schema: &'s Value, name: &str) -> &'s Value {
    let declared = schema.get("properties").and_then(|properties| properties.get(name));
    let other = || schema.get("additionalProperties").filter(|schema| schema.is_object());
    without_null(declared.or_else(other).unwrap_or(NO_SCHEMA))
}

/// The leaves of a value. Null is the same as nothing.
#[must_use]
pub fn leaves<'a>(schema: &Value, value: &'a Value) -> Leaves<'a> {
    let mut leaves = Leaves::new();
    collect(without_null(schema), value, &Path::default(), &mut leaves);
    leaves.remove(&Path::default());
    leaves
}

fn collect<'a>(schema: &Value, value: &'a Value, at: &Path, leaves: &mut Leaves<'a>) {
    match (shape(schema, value), value) {
        (_, Value::Null) => {}
        (Shape::Fields(_), Value::Object(members)) if members.values().all(Value::is_null) => {
            leaves.insert(at.clone(), Some(&NOTHING));
        }
        (Shape::Fields(schema), Value::Object(members)) => {
            for (name, member) in members {
                let at = at.then(Step::Field(name.clone()));
                collect(field(schema, name), member, &at, leaves);
            }
        }
        (Shape::Keyed(keys, items), Value::Array(elements)) if !elements.is_empty() => {
            for element in elements {
                let at = at.then(step(&keys, element));
                collect(items, element, &at, leaves);
                leaves.insert(at, None);
            }
        }
        (Shape::Set, Value::Array(elements)) if !elements.is_empty() => {
            for element in elements {
                leaves.insert(at.then(Step::Element(element.to_string())), None);
            }
        }
        _ => drop(leaves.insert(at.clone(), Some(value))),
    }
}

/// `live` with everything that `config` says.
#[must_use]
pub fn merge(schema: &Value, live: &Value, config: &Value) -> Value {
    let schema = without_null(schema);
    match (shape(schema, live), shape(schema, config), live, config) {
        (_, _, live, Value::Null) => live.clone(),
        (Shape::Fields(_), Shape::Fields(_), Value::Object(live), Value::Object(config)) => {
            let mut merged = live.clone();
            for (name, said) in config.iter().filter(|(_, said)| !said.is_null()) {
                let present = live.get(name).unwrap_or(&Value::Null);
                merged.insert(name.clone(), merge(field(schema, name), present, said));
            }
            Value::Object(merged)
        }
        (Shape::Keyed(keys, items), Shape::Keyed(..), Value::Array(live), Value::Array(config)) => {
            let mut merged = live.clone();
            let places = places(&keys, live);
            for said in config {
                let place = places.get(&step(&keys, said));
                match place.and_then(|place| merged.get_mut(*place)) {
                    Some(present) => *present = merge(items, present, said),
                    None => merged.push(merge(items, &Value::Null, said)),
                }
            }
            Value::Array(merged)
        }
        (Shape::Set, Shape::Set, Value::Array(live), Value::Array(config)) => {
            let present: BTreeSet<String> = live.iter().map(ToString::to_string).collect();
            let new = config.iter().filter(|said| !present.contains(&said.to_string()));
            Value::Array(live.iter().chain(new).cloned().collect())
        }
        // Nothing there yet: without the nulls that may be inside.
        (_, Shape::Fields(_), _, Value::Object(_)) => {
            merge(schema, &Value::Object(Map::new()), config)
        }
        _ => config.clone(),
    }
}

/// Where the elements of a list with keys are.
fn places(keys: &[&str], elements: &[Value]) -> BTreeMap<Step, usize> {
    elements.iter().enumerate().map(|(place, element)| (step(keys, element), place)).collect()
}

/// Takes fields and elements out of a value, and what is empty after that.
pub fn remove(schema: &Value, value: &mut Value, paths: &[&Path]) {
    let steps: Vec<&[Step]> = paths.iter().map(|path| path.steps()).collect();
    take(without_null(schema), value, &steps);
}

/// The same at one place of the value; the paths from there on, all at once.
fn take(schema: &Value, value: &mut Value, paths: &[&[Step]]) {
    let mut below: BTreeMap<&Step, Vec<&[Step]>> = BTreeMap::new();
    for (first, rest) in paths.iter().filter_map(|path| path.split_first()) {
        below.entry(first).or_default().push(rest);
    }
    let shape = shape(schema, value);
    match value {
        Value::Object(members) => {
            for (first, rests) in below {
                let Step::Field(name) = first else { continue };
                let Some(member) = members.get_mut(name) else { continue };
                take(field(schema, name), member, &rests);
                if rests.iter().any(|rest| rest.is_empty()) || is_empty(member) {
                    members.remove(name);
                }
            }
        }
        Value::Array(elements) => match shape {
            Shape::Keyed(keys, items) => take_elements(items, &keys, elements, &below),
            _ => {
                elements.retain(|element| !below.contains_key(&Step::Element(element.to_string())))
            }
        },
        _ => {}
    }
}

fn take_elements(
    items: &Value,
    keys: &[&str],
    elements: &mut Vec<Value>,
    below: &BTreeMap<&Step, Vec<&[Step]>>,
) {
    elements.retain_mut(|element| {
        let Some(rests) = below.get(&step(keys, element)) else { return true };
        // Without its key fields nobody would find the element again.
        let is_key = |rest: &&[Step]| {
            matches!(rest, [Step::Field(name)] if keys.iter().any(|key| *key == name))
        };
        let rests: Vec<&[Step]> = rests.iter().copied().filter(|rest| !is_key(rest)).collect();
        take(items, element, &rests);
        rests.iter().all(|rest| !rest.is_empty())
    });
}

fn is_empty(value: &Value) -> bool {
    match value {
        Value::Object(members) => members.is_empty(),
        Value::Array(elements) => elements.is_empty(),
        _ => false,
    }
}
