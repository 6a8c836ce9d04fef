//! Server-side apply: many clients say each a part of an object, and it is known which part is whose.
//!
//! The rules are those of Kubernetes' structured-merge-diff. A *manager* owns fields: by having applied them (it means
//! the object to have them as long as it says so), or by having changed them otherwise. Who applies a field that another
//! manager owns, with another value, is in conflict; with `force` the field becomes theirs. What a manager applied before
//! and does not any more goes away, unless somebody else owns it.
//!
//! | module | holds |
//! |---|---|
//! | [`path`] | paths to fields, and the form that `metadata.managedFields` has for sets of them |
//! | [`shape`] | values as the leaves that their schema gives them: what is merged, and what is replaced whole |

pub mod path;
pub mod shape;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use serde_json::Value;

use path::{Fields, Path};
use shape::Leaves;

/// How a manager came to its fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Operation {
    /// It applies them.
    Apply,
    /// It wrote them otherwise.
    Update,
}

/// Who owns fields.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Manager {
    /// The client's own name for itself, `fieldManager` of its requests.
    pub name: String,
    /// How it came to them.
    pub operation: Operation,
    /// Empty, or the subresource that it wrote through.
    pub subresource: String,
    /// The group and version that it wrote. Who applies a view of a kind says nothing of what the view does not show: it is
    /// another manager than the one of its name that applies the kind itself.
    pub version: String,
}

/// What a manager owns.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Owned {
    /// Its fields.
    pub fields: Fields,
    /// When it last changed what it owns, RFC 3339.
    pub time: String,
}

/// The owners of an object's fields. Two may own one field, with the same value.
pub type Owners = BTreeMap<Manager, Owned>;

/// A field that is somebody else's.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Conflict {
    /// Whose.
    pub manager: Manager,
    /// Since when.
    pub time: String,
    /// Which.
    pub path: Path,
}

/// What is applied.
#[derive(Debug, Clone, Copy)]
pub struct Application<'a> {
    /// By whom.
    pub manager: &'a Manager,
    /// What they mean the object to have.
    pub config: &'a Value,
    /// Takes fields of others.
    pub force: bool,
    /// Now, RFC 3339.
    pub time: &'a str,
}

/// What an object becomes, and whose its fields are, when `application` is applied to `live`. Both values hold only what
/// managers can own: nothing that is the server's.
///
/// # Errors
/// Every field of somebody else that would change.
pub fn apply(
    schema: &Value,
    live: &Value,
    owners: &Owners,
    application: Application<'_>,
) -> Result<(Value, Owners), Vec<Conflict>> {
    let Application { manager, config, force, time } = application;
    let said = shape::leaves(schema, config);
    let said_fields: Fields = said.keys().cloned().collect();
    let mut merged = shape::merge(schema, live, config);
    let conflicts = conflicts(owners, manager, &said, &shape::leaves(schema, live));
    if !force && !conflicts.is_empty() {
        return Err(conflicts);
    }
    let mut owners = owners.clone();
    for conflict in conflicts {
        if let Some(owned) = owners.get_mut(&conflict.manager) {
            owned.fields.remove(&conflict.path);
            time.clone_into(&mut owned.time);
        }
    }
    let before = owners.remove(manager);
    if let Some(before) = &before {
        let kept = |path: &Path| {
            let holds = |fields: &Fields| path::leads_into(path, fields.range(path..));
            holds(&said_fields) || owners.values().any(|owned| holds(&owned.fields))
        };
        let gone: Vec<&Path> = before.fields.iter().filter(|path| !kept(path)).collect();
        shape::remove(schema, &mut merged, &gone);
        // A list or map that is meant to be empty went with its last member.
        merged = shape::merge(schema, &merged, config);
    }
    let since = match before {
        Some(before) if before.fields == said_fields => before.time,
        _ => time.to_owned(),
    };
    owners.insert(manager.clone(), Owned { fields: said_fields, time: since });
    owners.retain(|_, owned| !owned.fields.is_empty());
    Ok((merged, owners))
}

/// The fields that others own and that would change.
fn conflicts(
    owners: &Owners,
    manager: &Manager,
    said: &Leaves<'_>,
    live: &Leaves<'_>,
) -> Vec<Conflict> {
    let changes = |path: &Path| match (said.get(path), live.get(path)) {
        (Some(said), Some(live)) => said != live,
        // What an owner has lost in the meantime is nobody's.
        _ => false,
    };
    let others = owners.iter().filter(|(other, _)| *other != manager);
    let of = |(other, owned): (&Manager, &Owned)| {
        let paths = owned.fields.iter().filter(|path| changes(path)).cloned();
        let conflict = |path| Conflict { manager: other.clone(), time: owned.time.clone(), path };
        paths.map(conflict).collect::<Vec<_>>()
    };
    others.flat_map(of).collect()
}

/// Whose the fields are after `manager` has made `new` of `live` by other means than applying.
#[must_use]
pub fn update(
    schema: &Value,
    live: &Value,
    new: &Value,
    owners: &Owners,
    (manager, time): (&Manager, &str),
) -> Owners {
    let (before, after) = (shape::leaves(schema, live), shape::leaves(schema, new));
    let changed: Fields = after
        .iter()
        .filter(|(path, value)| before.get(*path) != Some(value))
        .map(|(path, _)| path.clone())
        .collect();
    let mut owners = owners.clone();
    for (other, owned) in &mut owners {
        let count = owned.fields.len();
        owned.fields.retain(|path| {
            // Membership of a list goes with its element; a map that was empty may have got members.
            let there = path::leads_into(path, after.range(path..).map(|(path, _)| path));
            there && (other == manager || !changed.contains(path))
        });
        if owned.fields.len() != count {
            time.clone_into(&mut owned.time);
        }
    }
    if !changed.is_empty() {
        let own = owners.entry(manager.clone());
        let own = own.or_insert_with(|| Owned { fields: Fields::new(), time: String::new() });
        own.fields.extend(changed);
        time.clone_into(&mut own.time);
    }
    owners.retain(|_, owned| !owned.fields.is_empty());
    owners
}

/// Everything of `live`, as one manager's: who wrote an object before anybody kept account.
#[must_use]
pub fn all_of(schema: &Value, live: &Value) -> Fields {
    shape::leaves(schema, live).into_keys().collect()
}
