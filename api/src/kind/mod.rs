//! The resources. One file a kind: spec, status, rules. [`ALL`] is the one list of them, and
//! [`admit`] the one gate that an object passes before it is stored, in the client and the server.

pub mod access;
pub mod application;
pub mod config_map;
pub mod event;
pub mod framework;
pub mod keyed;
pub mod lease;
pub mod namespace;
pub mod node;
pub mod projected;
pub mod quota;
pub mod secret;
pub mod site;
pub mod task;
pub mod taskset;
pub mod taskset_revision;

use std::any::TypeId;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use schemars::generate::{SchemaGenerator, SchemaSettings};
use schemars::{JsonSchema, Schema};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::name::check_name;
use crate::selector::{Labels, check_labels};
use crate::validate::{Violations, did_you_mean, member_path};

/// What everybody needs to know of a kind.
#[derive(Debug)]
pub struct KindInfo {
    /// API group; empty for core kinds.
    pub group: &'static str,
    /// API version.
    pub version: &'static str,
    /// The kind, `Task`.
    pub kind: &'static str,
    /// Plural in paths, `tasks`.
    pub plural: &'static str,
    /// Singular, `task`.
    pub singular: &'static str,
    /// Short names, `tk`.
    pub short_names: &'static [&'static str],
    /// Lives in a namespace.
    pub namespaced: bool,
    /// `status` is a subresource.
    pub has_status: bool,
    /// Dotted field paths that a field selector may use, beside `metadata.name` and `metadata.namespace`.
    pub selectable: &'static [&'static str],
    /// The schema of the whole object.
    schema: fn(&mut SchemaGenerator) -> Schema,
    /// Checks the body of an object (all but metadata) and fills in defaults.
    admit_body: fn(&mut Value, &mut Violations),
    /// Checks that `new` may follow `old`.
    admit_change: fn(&Value, &Value, &mut Violations),
}

impl KindInfo {
    /// `group/version`, or `version` for core kinds.
    #[must_use]
    pub fn api_version(&self) -> String {
        if self.group.is_empty() {
            self.version.to_owned()
        } else {
            format!("{}/{}", self.group, self.version)
        }
    }
}

impl KindInfo {
    /// The schema of a whole object; what it refers to is left in the generator. Muster's own kinds do not say what
    /// `apiVersion`, `kind` and `metadata` are.
    pub fn schema(&self, generator: &mut SchemaGenerator) -> Schema {
        (self.schema)(generator)
    }

    /// The same with everything inlined, made once a kind: how the parts of an object are owned and merged.
    #[must_use]
    pub fn fields(&self) -> Arc<Value> {
        static MADE: Mutex<BTreeMap<(&str, &str), Arc<Value>>> = Mutex::new(BTreeMap::new());
        let make = || {
            let settings = SchemaSettings::draft2020_12().with(|s| s.inline_subschemas = true);
            let mut fields = self.schema(&mut settings.into_generator()).to_value();
            let metadata =
                schema_of::<k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta>();
            let mut metadata = Value::clone(&metadata);
            metadata["properties"]["finalizers"]["x-kubernetes-list-type"] = "set".into();
            metadata["properties"]["ownerReferences"]["x-kubernetes-list-type"] = "map".into();
            metadata["properties"]["ownerReferences"]["x-kubernetes-list-map-keys"] =
                serde_json::json!(["uid"]);
            fields["properties"]["metadata"] = metadata;
            Arc::new(fields)
        };
        let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
        Arc::clone(made.entry((self.group, self.kind)).or_insert_with(make))
    }
}

/// Every kind, in the order they are listed to people.
pub static ALL: &[KindInfo] = &[
    node::INFO,
    task::INFO,
    taskset::INFO,
    taskset_revision::INFO,
    application::INFO,
    lease::INFO,
    framework::INFO,
    quota::INFO,
    site::INFO,
    access::INFO,
    config_map::INFO,
    secret::INFO,
    namespace::INFO,
    event::INFO,
];

/// The kind with this `apiVersion` and `kind`.
#[must_use]
pub fn find(api_version: &str, kind: &str) -> Option<&'static KindInfo> {
    ALL.iter().find(|info| info.kind == kind && info.api_version() == api_version)
}

/// The kind that people mean by `word`: plural, singular, kind or short name, in any case.
#[must_use]
pub fn find_by_word(word: &str) -> Option<&'static KindInfo> {
    let word = word.to_ascii_lowercase();
    let names = |i: &KindInfo| {
        i.plural == word || i.singular == word || i.short_names.contains(&word.as_str())
    };
    ALL.iter().find(|i| names(i) || i.kind.to_ascii_lowercase() == word)
}

/// The schema of `T` with everything inlined, as [`crate::validate::walk_schema`] wants it. Made
/// once a type: every admission needs it.
#[must_use]
pub fn schema_of<T: JsonSchema + 'static>() -> Arc<Value> {
    static MADE: Mutex<BTreeMap<TypeId, Arc<Value>>> = Mutex::new(BTreeMap::new());
    let make = || {
        let settings = SchemaSettings::draft2020_12().with(|s| s.inline_subschemas = true);
        Arc::new(settings.into_generator().into_root_schema_for::<T>().to_value())
    };
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    Arc::clone(made.entry(TypeId::of::<T>()).or_insert_with(make))
}

/// Checks a whole object and gives it back with defaults filled in. Unknown fields are violations.
///
/// # Errors
///
/// Everything that is wrong with it.
pub fn admit(object: &Value) -> Result<Value, Violations> {
    let mut violations = Violations::new();
    let mut object = object.clone();
    let Some(info) = kind_of(&object, &mut violations) else {
        return Err(violations);
    };
    check_metadata(info, &object, &mut violations);
    check_top_level(info, &object, &mut violations);
    (info.admit_body)(&mut object, &mut violations);
    violations.into_result(object)
}

/// Checks that `new`, itself admitted, may replace `old`.
///
/// # Errors
///
/// Each field that must not change, by path.
pub fn admit_change(info: &KindInfo, old: &Value, new: &Value) -> Result<(), Violations> {
    let mut violations = Violations::new();
    (info.admit_change)(old, new, &mut violations);
    violations.into_result(())
}

fn kind_of(object: &Value, violations: &mut Violations) -> Option<&'static KindInfo> {
    let text = |field: &str| object.get(field).and_then(Value::as_str).filter(|t| !t.is_empty());
    let (Some(api_version), Some(kind)) = (text("apiVersion"), text("kind")) else {
        for (field, example) in [("apiVersion", crate::API_VERSION), ("kind", "Task")] {
            if text(field).is_none() {
                violations.required(field).suggest(format!("for example {example:?}"));
            }
        }
        return None;
    };
    if let Some(info) = find(api_version, kind) {
        return Some(info);
    }
    if let Some(info) = ALL.iter().find(|i| i.kind == kind) {
        let reason = format!("{api_version:?} has no kind {kind:?}");
        violations
            .not_supported("apiVersion", reason)
            .suggest(format!("try {:?}", info.api_version()));
    } else {
        let near = did_you_mean(kind, ALL.iter().map(|i| i.kind));
        violations
            .not_supported("kind", format!("{kind:?} is not a kind that muster serves"))
            .suggestion = near;
    }
    None
}

fn check_metadata(info: &KindInfo, object: &Value, violations: &mut Violations) {
    let Some(metadata) = object.get("metadata").filter(|m| !m.is_null()) else {
        violations.required("metadata.name");
        return;
    };
    let known = schema_of::<k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta>();
    let before = violations.iter().count();
    crate::validate::walk_schema(&known, metadata, "metadata", violations);
    for key in metadata.as_object().into_iter().flat_map(|m| m.keys()) {
        if violations.is_full() {
            return;
        }
        let properties = known.get("properties").and_then(Value::as_object);
        if let Some(properties) = properties.filter(|p| !p.contains_key(key)) {
            let near = did_you_mean(key, properties.keys().map(String::as_str));
            violations.not_supported(member_path("metadata", key), "is not a field").suggestion =
                near;
        }
    }
    if violations.iter().count() > before {
        return;
    }
    let text = |field: &str| metadata.get(field).and_then(Value::as_str).filter(|t| !t.is_empty());
    match text("name") {
        Some(name) => {
            if let Err(error) = check_name(name) {
                let near = error.suggestion().map(|s| format!("try {s:?}"));
                violations.invalid("metadata.name", error.to_string()).suggestion = near;
            }
        }
        None if text("generateName").is_some() => {}
        None => {
            violations.required("metadata.name");
        }
    }
    let labels = metadata.get("labels").cloned().unwrap_or_default();
    let labels = serde_json::from_value::<Option<Labels>>(labels).ok().flatten();
    check_labels(&labels.unwrap_or_default(), "metadata.labels", violations);
    match text("namespace") {
        Some(_) if !info.namespaced => {
            violations
                .forbidden("metadata.namespace", format!("a {} belongs to no namespace", info.kind))
                .suggest("leave it out");
        }
        Some(namespace) => {
            if let Err(error) = check_name(namespace) {
                violations.invalid("metadata.namespace", error.to_string());
            }
        }
        None => {}
    }
}

fn check_top_level(info: &KindInfo, object: &Value, violations: &mut Violations) {
    if info.group.is_empty() {
        return;
    }
    const KNOWN: [&str; 5] = ["apiVersion", "kind", "metadata", "spec", "status"];
    for key in object
        .as_object()
        .into_iter()
        .flat_map(|o| o.keys())
        .filter(|k| !KNOWN.contains(&k.as_str()))
    {
        if violations.is_full() {
            return;
        }
        violations.not_supported(member_path("", key), "is not a field").suggestion =
            did_you_mean(key, KNOWN);
    }
}

/// Admission of a `spec`: schema, then types, then the kind's own rules; writes the typed value
/// back, so that what is stored has its defaults.
fn admit_spec<S: JsonSchema + Serialize + DeserializeOwned + 'static>(
    object: &mut Value,
    violations: &mut Violations,
    rules: fn(&S, &mut Violations),
) {
    let Some(spec) = object.get_mut("spec").filter(|s| !s.is_null()) else {
        violations.required("spec");
        return;
    };
    let mut found = Violations::new();
    crate::validate::walk_schema(&schema_of::<S>(), spec, "spec", &mut found);
    remove_nulls(spec);
    if found.is_empty() {
        match serde_path_to_error::deserialize::<_, S>(&*spec) {
            Ok(typed) => {
                rules(&typed, &mut found);
                *spec = serde_json::to_value(&typed)
                    .expect("a spec's fields are texts, numbers, lists and maps");
            }
            Err(error) => {
                let path = format!("spec.{}", error.path());
                found.invalid(path, error.inner().to_string());
            }
        }
    } else {
        found.append(rules_on_the_rest(spec, &found, rules));
    }
    violations.append(found);
}

/// What a kind's own rules find in a spec whose schema violations are cut out of it, so that one
/// reading finds both sorts. Nothing, when what is left does not make a spec.
fn rules_on_the_rest<S: DeserializeOwned>(
    spec: &Value,
    found: &Violations,
    rules: fn(&S, &mut Violations),
) -> Violations {
    let mut rest = spec.clone();
    let mut cut = Vec::new();
    for violation in found.iter() {
        // A list without one of its elements would number the others anew: the list goes whole.
        let path = violation.path.split('[').next().unwrap_or_default();
        let pointer = path.strip_prefix("spec").unwrap_or_default().replace('.', "/");
        let Some((parent, member)) = pointer.rsplit_once('/') else { return Violations::new() };
        if let Some(members) = rest.pointer_mut(parent).and_then(Value::as_object_mut) {
            members.remove(member);
        }
        cut.push(path.to_owned());
    }
    let mut more = Violations::new();
    if let Ok(typed) = serde_json::from_value::<S>(rest) {
        rules(&typed, &mut more);
    }
    // What is missing because it was cut out, or is about something around it, is said already.
    more.retain(|v| !cut.iter().any(|c| c.starts_with(&v.path) || v.path.starts_with(c.as_str())));
    more
}

fn remove_nulls(value: &mut Value) {
    match value {
        Value::Object(members) => {
            members.retain(|_, m| !m.is_null());
            members.values_mut().for_each(remove_nulls);
        }
        Value::Array(elements) => elements.iter_mut().for_each(remove_nulls),
        _ => {}
    }
}

/// Admission of a core kind that k8s-openapi describes: its types must read it, and have every field of it.
fn admit_core<T: JsonSchema + DeserializeOwned + 'static>(
    object: &mut Value,
    violations: &mut Violations,
) {
    let schema = schema_of::<T>();
    let known = schema["properties"].as_object();
    for (key, member) in object.as_object().into_iter().flatten() {
        // Metadata is looked at for every kind.
        match known.and_then(|known| known.get(key)) {
            _ if key == "metadata" || member.is_null() => {}
            Some(schema) => crate::validate::walk_fields(schema, member, key, violations),
            None => {
                let known = known.into_iter().flat_map(|known| known.keys());
                violations.not_supported(member_path("", key), "is not a field").suggestion =
                    did_you_mean(key, known.map(String::as_str));
            }
        }
        if violations.is_full() {
            return;
        }
    }
    if let Err(error) = serde_path_to_error::deserialize::<_, T>(&*object) {
        violations.invalid(error.path().to_string(), error.inner().to_string());
    }
}

fn any_change(_: &Value, _: &Value, _: &mut Violations) {}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn problems(object: &Value) -> Vec<String> {
        admit(object).expect_err("not admitted").iter().map(ToString::to_string).collect()
    }

    #[test]
    fn kinds_are_found_by_every_name_they_have() {
        for word in ["task", "tasks", "Task", "tk", "TASKS"] {
            assert_eq!(find_by_word(word).map(|i| i.kind), Some("Task"), "{word}");
        }
        assert!(find_by_word("pod").is_none());
    }

    #[test]
    fn what_object_it_is_must_be_said() {
        assert_eq!(
            problems(&json!({"metadata": {"name": "x"}})),
            [
                "apiVersion: is required; for example \"muster.dev/v1alpha1\"",
                "kind: is required; for example \"Task\""
            ]
        );
        assert_eq!(
            problems(&json!({"apiVersion": "v1", "kind": "Task"})),
            ["apiVersion: \"v1\" has no kind \"Task\"; try \"muster.dev/v1alpha1\""]
        );
        assert_eq!(
            problems(&json!({"apiVersion": "v1", "kind": "Namspace"})),
            ["kind: \"Namspace\" is not a kind that muster serves; did you mean \"Namespace\"?"]
        );
    }

    #[test]
    fn metadata_is_checked() {
        let namespace = |metadata: Value| json!({"apiVersion": "v1", "kind": "Namespace", "metadata": metadata});
        assert_eq!(
            problems(&namespace(json!({"name": "My_Lab", "namespace": "x"}))),
            [
                "metadata.name: \"My_Lab\" is not a name: lower-case letters, digits and '-' only, beginning and ending with a letter or digit; try \"my-lab\"",
                "metadata.namespace: a Namespace belongs to no namespace; leave it out",
            ]
        );
        assert_eq!(
            problems(&namespace(json!({"nam": "x"})))[0],
            "metadata.nam: is not a field; did you mean \"name\"?"
        );
        assert_eq!(problems(&namespace(json!({})))[0], "metadata.name: is required");
        admit(&namespace(json!({"name": "lab", "labels": {"a.b/c": "d"}}))).expect("good");
    }

    #[test]
    fn core_kinds_have_no_other_fields_than_kubernetes_says() {
        let event = |fields: Value| {
            let mut event = json!({"apiVersion": "v1", "kind": "Event", "metadata": {"name": "e"},
                "involvedObject": {"kind": "Task", "name": "t"}, "reason": "Started", "count": 1,
                "source": {"component": "x"}, "eventTime": null});
            event
                .as_object_mut()
                .expect("fields")
                .extend(fields.as_object().expect("fields").clone());
            event
        };
        admit(&event(json!({"series": {"count": 2}}))).expect("good");
        let wrong =
            event(json!({"foo": {"a": 1}, "series": {"cuont": 2}, "involvedObject": {"nam": "t"}}));
        assert_eq!(
            problems(&wrong),
            [
                "foo: is not a field",
                "involvedObject.nam: is not a field; did you mean \"name\"?",
                "series.cuont: is not a field; did you mean \"count\"?",
            ]
        );
        let namespace = json!({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": "lab"},
            "spec": {"finalizers": ["kubernetes"]}, "status": {"phase": "Active", "more": {}}});
        assert_eq!(problems(&namespace), ["status.more: is not a field"]);
    }
}
