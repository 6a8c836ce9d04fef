//! `metadata.managedFields`: whose each field of an object is.
//!
//! It is kept from the first server-side apply of an object on: what was there before belongs to `before-first-apply`, or
//! to `kubectl-client-side-apply` where the object says that kubectl made it. Objects that nobody applies on the server
//! carry no such list, which is as long as themselves. Who writes through a view of a kind (a core Node) is another manager
//! than who writes the kind: its `apiVersion` tells them apart.

use muster_controller_core::apply::{self, Conflict, Manager, Operation, Owned, Owners, path};
use serde_json::{Map, Value, json};

use super::failure::Failure;
use super::registry::Entry;

/// The annotation in which `kubectl apply` keeps what it applied.
const LAST_APPLIED: &str = "kubectl.kubernetes.io/last-applied-configuration";
/// Fields of `metadata` that nobody but the server owns.
const SERVERS: [&str; 11] = [
    "name",
    "namespace",
    "generateName",
    "uid",
    "resourceVersion",
    "generation",
    "creationTimestamp",
    "deletionTimestamp",
    "deletionGracePeriodSeconds",
    "managedFields",
    "selfLink",
];

/// Who writes.
#[derive(Debug, Clone)]
pub(super) struct Writer {
    /// `fieldManager`, or the first word of the user agent.
    pub(super) name: String,
    pub(super) subresource: &'static str,
    /// The version of the view that is written through, if any.
    pub(super) view: Option<String>,
    /// Now, RFC 3339.
    pub(super) time: String,
}

impl Writer {
    fn manager(&self, entry: &Entry, operation: Operation) -> Manager {
        Manager {
            name: self.name.clone(),
            operation,
            subresource: self.subresource.to_owned(),
            version: self.view.clone().unwrap_or_else(|| entry.info.api_version()),
        }
    }
}

/// What of an object can be owned.
fn ownable(object: &Value) -> Value {
    let mut object = object.clone();
    if let Some(fields) = object.as_object_mut() {
        fields.remove("apiVersion");
        fields.remove("kind");
    }
    if let Some(metadata) = object["metadata"].as_object_mut() {
        for field in SERVERS {
            metadata.remove(field);
        }
    }
    if object["metadata"].as_object().is_none_or(Map::is_empty)
        && let Some(fields) = object.as_object_mut()
    {
        fields.remove("metadata");
    }
    object
}

/// The owners that an object names; none: nobody keeps account of it.
pub(super) fn of(object: &Value) -> Option<Owners> {
    let entries = object["metadata"]["managedFields"].as_array()?;
    let read = |entry: &Value| {
        let text = |field: &str| entry[field].as_str().unwrap_or_default().to_owned();
        let operation = match entry["operation"].as_str()? {
            "Apply" => Operation::Apply,
            "Update" => Operation::Update,
            _ => return None,
        };
        let manager = Manager {
            name: text("manager"),
            operation,
            subresource: text("subresource"),
            version: text("apiVersion"),
        };
        Some((manager, Owned { fields: path::read(&entry["fieldsV1"]), time: text("time") }))
    };
    let owners: Owners = entries.iter().filter_map(read).collect();
    (!owners.is_empty()).then_some(owners)
}

/// The owners as an object names them.
pub(super) fn write(owners: &Owners) -> Value {
    let one = |(manager, owned): (&Manager, &Owned)| {
        let mut written = json!({
            "manager": manager.name,
            "operation": match manager.operation {
                Operation::Apply => "Apply",
                Operation::Update => "Update",
            },
            "apiVersion": manager.version,
            "time": owned.time,
            "fieldsType": "FieldsV1",
            "fieldsV1": path::write(&owned.fields),
        });
        if !manager.subresource.is_empty() {
            written["subresource"] = manager.subresource.as_str().into();
        }
        written
    };
    owners.iter().map(one).collect()
}

/// The owners of `new`, which `writer` made of `old` otherwise than by applying; none: nobody keeps account. `said` is
/// the list that the client sent: it may take itself or others out, and an empty one ends the account.
pub(super) fn after_update(
    entry: &Entry,
    (old, new): (&Value, &Value),
    said: Option<&Value>,
    writer: &Writer,
) -> Option<Value> {
    let known = &old["metadata"]["managedFields"];
    let owners = match said {
        Some(said) if said != known => of(&json!({"metadata": {"managedFields": said}}))?,
        _ => of(old)?,
    };
    let manager = writer.manager(entry, Operation::Update);
    let by = (&manager, &*writer.time);
    let after = apply::update(&entry.info.fields(), &ownable(old), &ownable(new), &owners, by);
    (!after.is_empty()).then(|| write(&after))
}

/// What an object becomes when `config` is applied to it; `live` is null when there is none yet. The answer names its
/// owners.
pub(super) fn applied(
    entry: &Entry,
    live: &Value,
    config: &Value,
    writer: &Writer,
    force: bool,
) -> Result<Value, Failure> {
    let schema = entry.info.fields();
    let owned = if live.is_null() { json!({}) } else { ownable(live) };
    let owners = match of(live) {
        Some(owners) => owners,
        None if live.is_null() => Owners::new(),
        None => first(entry, live, &owned),
    };
    let mut own = ownable(config);
    if let Some(fields) = own.as_object_mut() {
        match writer.subresource {
            "" if entry.info.has_status => drop(fields.remove("status")),
            "" => {}
            subresource => fields.retain(|field, _| field == subresource),
        }
    }
    let manager = writer.manager(entry, Operation::Apply);
    let application =
        |force| apply::Application { manager: &manager, config: &own, force, time: &writer.time };
    let result = match apply::apply(&schema, &owned, &owners, application(force)) {
        // kubectl moves from applying by itself to applying here: what it wrote before is its own.
        Err(conflicts) if writer.name == "kubectl" && all_kubectls(&schema, live, &conflicts) => {
            apply::apply(&schema, &owned, &owners, application(true))
        }
        result => result,
    };
    let (mut object, owners) = result.map_err(|conflicts| conflict(entry, config, &conflicts))?;
    object["apiVersion"] = entry.info.api_version().into();
    object["kind"] = entry.info.kind.into();
    for field in SERVERS {
        if let Some(value) = live["metadata"].get(field) {
            object["metadata"][field] = value.clone();
        }
    }
    // What the client says about which object it means is held against the object.
    for field in ["name", "namespace", "uid", "resourceVersion"] {
        match config["metadata"].get(field).filter(|value| !value.is_null()) {
            Some(said) => object["metadata"][field] = said.clone(),
            None if field == "resourceVersion" => {
                if let Some(metadata) = object["metadata"].as_object_mut() {
                    metadata.remove(field);
                }
            }
            None => {}
        }
    }
    object["metadata"]["managedFields"] = write(&owners);
    Ok(object)
}

/// Who owns an object of which nobody has kept account: kubectl what it says that it applied, else somebody all of it.
fn first(entry: &Entry, live: &Value, owned: &Value) -> Owners {
    let schema = &entry.info.fields();
    let (name, fields) = match last_applied(live) {
        Some(last) => {
            let there = apply::all_of(schema, owned);
            let said = apply::all_of(schema, &ownable(&last));
            ("kubectl-client-side-apply", said.intersection(&there).cloned().collect())
        }
        None => {
            let mut said = owned.clone();
            if let Some(fields) = said.as_object_mut() {
                fields.remove("status");
            }
            ("before-first-apply", apply::all_of(schema, &said))
        }
    };
    let manager = Manager {
        name: name.to_owned(),
        operation: Operation::Update,
        subresource: String::new(),
        version: entry.info.api_version(),
    };
    let time = live["metadata"]["creationTimestamp"].as_str().unwrap_or_default().to_owned();
    Owners::from([(manager, Owned { fields, time })])
}

/// What kubectl says that it applied itself.
fn last_applied(live: &Value) -> Option<Value> {
    let last = live["metadata"]["annotations"].get(LAST_APPLIED)?.as_str()?;
    serde_json::from_str(last).ok().filter(Value::is_object)
}

/// Whether all of this is what kubectl says that it applied itself.
fn all_kubectls(schema: &Value, live: &Value, conflicts: &[Conflict]) -> bool {
    let Some(last) = last_applied(live) else { return false };
    let fields = apply::all_of(schema, &ownable(&last));
    let by_itself = |manager: &Manager| {
        manager.operation == Operation::Update && manager.name == "kubectl-client-side-apply"
    };
    conflicts.iter().all(|conflict| {
        let said =
            fields.contains(&conflict.path) || conflict.path.to_string().contains("last-applied");
        said && by_itself(&conflict.manager)
    })
}

fn conflict(entry: &Entry, config: &Value, conflicts: &[Conflict]) -> Failure {
    let with = |conflict: &Conflict| {
        let with = format!("conflict with {:?}", conflict.manager.name);
        let through = match conflict.manager.subresource.as_str() {
            "" => String::new(),
            subresource => format!(" with subresource {subresource:?}"),
        };
        match conflict.manager.operation {
            Operation::Apply => format!("{with}{through}"),
            Operation::Update => {
                let version = &conflict.manager.version;
                format!("{with}{through} using {version} at {}", conflict.time)
            }
        }
    };
    let causes: Vec<Value> = conflicts
        .iter()
        .map(|conflict| {
            json!({
                "reason": "FieldManagerConflict", "message": with(conflict),
                "field": conflict.path.to_string(),
            })
        })
        .collect();
    let listed: Vec<String> =
        conflicts.iter().map(|c| format!("{}: {}", with(c), c.path)).collect();
    let count = match conflicts.len() {
        1 => "1 conflict".to_owned(),
        several => format!("{several} conflicts"),
    };
    let message = format!("Apply failed with {count}: {}", listed.join("; "));
    let name = config["metadata"]["name"].as_str().unwrap_or_default();
    Failure::new(http::StatusCode::CONFLICT, "Conflict", message)
        .about(entry, name)
        .with_causes(causes)
}
