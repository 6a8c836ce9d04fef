//! Tasks that reach past themselves into their nodes: who has no access to hosts (`Access.spec.hostAccess`) writes none, in
//! whatever kind they stand, and enters none.
//!
//! What stands in an object already is not looked at again: who may not write such a program may scale, label and delete it.

use muster_api::kind::task::{Task, TaskSpec};
use muster_api::validate::{Violations, element_path};
use muster_controller_core::access::host::{self, Reached};
use serde::Deserialize as _;
use serde_json::Value;

use super::failure::Failure;
use super::metadata;
use crate::auth::Asker;

/// Refuses what somebody's object (`new`) would reach of nodes, as far as it is not so at `present`.
pub(crate) fn check(asker: &Asker, present: &Value, new: &Value) -> Violations {
    let mut violations = Violations::new();
    let namespace = metadata::text(new, "namespace").unwrap_or_default();
    if host::allowed(&asker.who, namespace) {
        return violations;
    }
    let before = programs(present);
    for (path, spec) in programs(new) {
        if before.iter().any(|(_, known)| *known == spec) {
            continue;
        }
        let spec = match TaskSpec::deserialize(spec) {
            Ok(spec) => spec,
            Err(error) => {
                violations.invalid(path, error.to_string());
                continue;
            }
        };
        // What was stored before a field was there says less, and means the same.
        let known = |known: &Value| TaskSpec::deserialize(known).is_ok_and(|known| known == spec);
        if before.iter().any(|(_, before)| known(before)) {
            continue;
        }
        for reached in host::reached(&spec) {
            violations
                .forbidden(format!("{path}.{}", reached.field()), why(asker, namespace, &reached))
                .suggest(format!("{}, or have `hostAccess` by an Access", reached.instead()));
        }
    }
    violations
}

/// Whether somebody may run programs inside a task.
///
/// # Errors
///
/// 403: the task has what they have not.
pub(super) fn check_entry(asker: &Asker, task: &Task) -> Result<(), Failure> {
    let namespace = task.metadata.namespace.as_deref().unwrap_or_default();
    if host::allowed(&asker.who, namespace) {
        return Ok(());
    }
    match host::reached(&task.spec).first() {
        None => Ok(()),
        Some(reached) => Err(Failure::denied(format!(
            "the task reaches into its node (spec.{}): {}; an Access with `hostAccess` lets them in",
            reached.field(),
            why(asker, namespace, reached)
        ))),
    }
}

fn why(asker: &Asker, namespace: &str, reached: &Reached) -> String {
    let who = asker.identity.name();
    format!("{reached}, and User {who:?} has no access to hosts in the namespace {namespace:?}")
}

/// The task specs in an object, with their paths.
fn programs(object: &Value) -> Vec<(String, &Value)> {
    let one = |at: &str, path: &str| {
        let spec = object.pointer(at);
        spec.map(|spec| (path.to_owned(), spec)).into_iter().collect()
    };
    match object["kind"].as_str() {
        Some("Task") => one("/spec", "spec"),
        Some("TaskSet") => one("/spec/template/spec", "spec.template.spec"),
        Some("Application") => {
            let parts = object.pointer("/spec/parts").and_then(Value::as_array);
            let parts = parts.into_iter().flatten().enumerate();
            let spec = |(i, part): (usize, _)| {
                let path = format!("{}.template.spec", element_path("spec.parts", i));
                Some((path, Value::pointer(part, "/template/spec")?))
            };
            parts.filter_map(spec).collect()
        }
        _ => Vec::new(),
    }
}
