//! Schemas of kinds, in OpenAPI 3.0's dialect and under Kubernetes' names.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{DeleteOptions, ListMeta, ObjectMeta, Status};
use muster_api::kind::KindInfo;
use schemars::generate::{SchemaGenerator, SchemaSettings};
use serde_json::{Map, Value, json};

/// The schemas of one document.
#[derive(Debug)]
pub(super) struct Components {
    generator: SchemaGenerator,
    /// What is said of kinds beside their types.
    roots: Vec<(String, &'static KindInfo)>,
}

const REF: &str = "#/components/schemas/";

impl Components {
    pub(super) fn new() -> Self {
        let mut generator = SchemaSettings::openapi3().into_generator();
        generator.subschema_for::<ObjectMeta>();
        generator.subschema_for::<ListMeta>();
        generator.subschema_for::<Status>();
        generator.subschema_for::<DeleteOptions>();
        Self { generator, roots: Vec::new() }
    }

    /// Adds a kind; returns the name of its schema.
    pub(super) fn add(&mut self, info: &'static KindInfo) -> String {
        let schema = info.schema(&mut self.generator).to_value();
        let name = schema["$ref"].as_str().and_then(|r| r.strip_prefix(REF));
        let name = name.expect("a kind is a type with a name").to_owned();
        self.roots.push((name.clone(), info));
        qualified(&name)
    }

    pub(super) fn finish(mut self) -> Map<String, Value> {
        let mut schemas = Map::new();
        for (name, mut schema) in self.generator.take_definitions(true) {
            translate(&mut schema);
            schemas.insert(qualified(&name), schema);
        }
        for (name, info) in self.roots {
            let name = qualified(&name);
            if let Some(schema) = schemas.get_mut(&name) {
                complete(schema, info);
            }
            schemas.insert(format!("{name}List"), list(&name, info));
        }
        schemas
    }
}

/// Names of ours with the group before them, as Kubernetes' are.
fn qualified(name: &str) -> String {
    if name.contains('.') { name.to_owned() } else { format!("dev.muster.v1alpha1.{name}") }
}

fn kind_of(info: &KindInfo, suffix: &str) -> Value {
    json!([{"group": info.group, "version": info.version, "kind": format!("{}{suffix}", info.kind)}])
}

/// What every object has, and which kind it is.
fn complete(schema: &mut Value, info: &KindInfo) {
    schema["type"] = "object".into();
    schema["x-kubernetes-group-version-kind"] = kind_of(info, "");
    let text = |description: &str| json!({"type": "string", "description": description});
    let properties = &mut schema["properties"];
    properties["apiVersion"] = text("The group and version of the kind.");
    properties["kind"] = text("The kind.");
    properties["metadata"] = json!({
        "description": "Name, labels and what the server knows of the object.", "default": {},
        "allOf": [{"$ref": format!("{REF}io.k8s.apimachinery.pkg.apis.meta.v1.ObjectMeta")}],
    });
}

fn list(name: &str, info: &KindInfo) -> Value {
    json!({
        "type": "object", "required": ["items"],
        "description": format!("A list of {}.", info.plural),
        "properties": {
            "apiVersion": {"type": "string"},
            "kind": {"type": "string"},
            "metadata": {"allOf": [{"$ref": format!("{REF}io.k8s.apimachinery.pkg.apis.meta.v1.ListMeta")}]},
            "items": {"type": "array", "items": {"allOf": [{"$ref": format!("{REF}{name}")}]}},
        },
        "x-kubernetes-group-version-kind": kind_of(info, "List"),
    })
}

/// From what schemars writes to what kubectl reads: references by their new names, one type each, enums of texts.
fn translate(value: &mut Value) {
    match value {
        Value::Array(elements) => elements.iter_mut().for_each(translate),
        Value::Object(members) => {
            if let Some(Value::String(target)) = members.get_mut("$ref")
                && let Some(name) = target.strip_prefix(REF)
            {
                *target = format!("{REF}{}", qualified(name));
            }
            alternatives(members);
            if let Some(Value::Array(types)) = members.get("type") {
                let real = types.iter().find(|t| *t != "null").cloned();
                members.insert("type".into(), real.unwrap_or_else(|| "string".into()));
            }
            match members.get("format").and_then(Value::as_str) {
                Some("uint8" | "uint16" | "uint32" | "int8" | "int16") => {
                    members.insert("format".into(), "int32".into());
                }
                Some("uint64" | "uint") => drop(members.insert("format".into(), "int64".into())),
                _ => {}
            }
            if members.get("default").is_some_and(Value::is_null) {
                members.remove("default");
            }
            // A quantity is a number or a text; kubectl shows it as a text.
            if members.contains_key("x-kubernetes-int-or-string") && !members.contains_key("type") {
                members.remove("x-kubernetes-int-or-string");
                members.insert("type".into(), "string".into());
            }
            members.values_mut().for_each(translate);
        }
        _ => {}
    }
}

/// One of several: an enum of texts, or one type that may be null.
fn alternatives(members: &mut Map<String, Value>) {
    for word in ["oneOf", "anyOf"] {
        let Some(Value::Array(branches)) = members.get(word).cloned() else { continue };
        let real: Vec<&Value> =
            branches.iter().filter(|b| b["type"] != "null" && b["enum"] != json!([null])).collect();
        let texts: Vec<Value> =
            real.iter().filter_map(|b| b["enum"].as_array()).flatten().cloned().collect();
        if real.iter().all(|branch| branch["enum"].is_array()) {
            let said = real.iter().filter_map(|b| {
                Some(format!("{}: {}", b["enum"][0].as_str()?, b["description"].as_str()?))
            });
            let said: Vec<String> = said.collect();
            let before = members.get("description").and_then(Value::as_str).unwrap_or_default();
            let description = [before, &said.join("\n")].join("\n\n");
            members.remove(word);
            members.insert("type".into(), "string".into());
            members.insert("enum".into(), texts.into());
            members.insert("description".into(), description.trim().into());
        } else if let [only] = real[..] {
            let only = only.clone();
            members.remove(word);
            if only.get("$ref").is_some() {
                members.insert("allOf".into(), json!([only]));
            } else if let Value::Object(only) = only {
                for (name, value) in only {
                    members.entry(name).or_insert(value);
                }
            }
        }
    }
}
