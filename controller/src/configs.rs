//! ConfigMaps and Secrets, from the store to the tasks that name them.

use std::collections::BTreeMap;
use std::sync::Arc;

use muster_api::kind::task::TaskSpec;
use muster_api::kind::task::config::Source;
use muster_api::kind::{config_map, secret};
use muster_api::wire::agent::v1 as wire;
use muster_controller_core::config::{self, Resolved, Values};
use muster_controller_core::hold::Hold;
use serde_json::Value;

use crate::objects;
use crate::store::{Key, Resource, Store, Stored};

/// ConfigMaps.
pub const CONFIG_MAPS: Resource = Resource::new("configmaps");
/// Secrets.
pub const SECRETS: Resource = Resource::new("secrets");

/// The key of an object that a task of `namespace` names.
#[must_use]
pub fn key_of(source: Source, namespace: &str, name: &str) -> Key {
    let resource = match source {
        Source::ConfigMap => CONFIG_MAPS,
        Source::Secret => SECRETS,
    };
    Key::namespaced(resource, namespace, name)
}

/// Whether tasks may name objects of this resource.
#[must_use]
pub fn is_source(resource: Resource) -> bool {
    resource == CONFIG_MAPS || resource == SECRETS
}

fn read(source: Source, object: &Value) -> Option<BTreeMap<String, Vec<u8>>> {
    match source {
        Source::ConfigMap => config_map::values(object),
        Source::Secret => secret::values(object),
    }
}

/// The values of a stored object. One that does not read counts as not there; what is wrong with it is not said, for
/// that would show of it.
fn values(stored: &Stored) -> Option<Values> {
    let secret = stored.key.resource == SECRETS;
    let source = if secret { Source::Secret } else { Source::ConfigMap };
    let values = read(source, &stored.value());
    if values.is_none() {
        tracing::error!(key = %stored.key, "a stored object does not read as its kind; it is ignored");
    }
    values.map(Arc::new)
}

/// What a task of `namespace` gets now, or what holds it.
///
/// # Errors
///
/// Everything that is missing.
pub fn resolve(store: &Store, namespace: &str, spec: &TaskSpec) -> Result<Resolved, Vec<Hold>> {
    config::resolve(spec, |source, name| values(&*store.get(&key_of(source, namespace, name))?))
}

/// What holds a task of `namespace`.
#[must_use]
pub fn holds(store: &Store, namespace: &str, spec: &TaskSpec) -> Vec<Hold> {
    // Most tasks name nothing.
    if spec.references().is_empty() {
        return Vec::new();
    }
    resolve(store, namespace, spec).err().unwrap_or_default()
}

/// The same when `objects`, manifests that were admitted, are stored as well.
#[must_use]
pub fn holds_with(store: &Store, objects: &[Value], namespace: &str, spec: &TaskSpec) -> Vec<Hold> {
    let planned = |source: Source, name: &str| {
        let kind = match source {
            Source::ConfigMap => "ConfigMap",
            Source::Secret => "Secret",
        };
        objects::among(objects, kind, (namespace, name))
    };
    let find = |source: Source, name: &str| match planned(source, name) {
        Some(object) => {
            let object = muster_api::kind::admit(object).ok()?;
            read(source, &object).map(Arc::new)
        }
        None => values(&*store.get(&key_of(source, namespace, name))?),
    };
    config::resolve(spec, find).err().unwrap_or_default()
}

/// What the agent of a placed task is sent; none: the task names nothing.
#[must_use]
pub fn to_wire(store: &Store, namespace: &str, spec: &TaskSpec) -> Option<wire::Config> {
    if spec.references().is_empty() {
        return None;
    }
    Some(match resolve(store, namespace, spec) {
        Ok(Resolved { variables, files }) => wire::Config {
            variables: variables
                .into_iter()
                .map(|v| wire::Variable { name: v.name, value: v.value })
                .collect(),
            files: files
                .into_iter()
                .map(|f| wire::File {
                    directory: f.directory,
                    path: f.path,
                    data: f.data.into(),
                    mode: f.mode,
                    secret: f.secret,
                })
                .collect(),
            unresolved: None,
        },
        Err(holds) => wire::Config {
            unresolved: holds.first().map(|hold| wire::Unresolved {
                reason: hold.reason().to_owned(),
                message: hold.to_string(),
            }),
            ..wire::Config::default()
        },
    })
}
