//! What no TaskSet may be, and what of one may not change.

use serde_json::Value;

use super::{MAX_SET_NAME_LEN, REVISION_LABEL, SET_LABEL, TaskSetSpec, UnreachablePolicy};
use crate::kind::admit_spec;
use crate::kind::task::{RestartPolicy, TaskSpec, rules as task_rules};
use crate::selector::check_labels;
use crate::validate::{Violations, member_path};

pub(super) fn admit_body(object: &mut Value, violations: &mut Violations) {
    let name = object.pointer("/metadata/name").and_then(Value::as_str);
    if let Some(name) = name.filter(|n| n.len() > MAX_SET_NAME_LEN) {
        violations
            .invalid(
                "metadata.name",
                format!("is {} bytes long, at most {MAX_SET_NAME_LEN} are allowed", name.len()),
            )
            .suggest("the names of its tasks and revisions begin with it and are longer");
    }
    admit_spec::<TaskSetSpec>(object, violations, rules);
}

pub(super) fn rules(spec: &TaskSetSpec, violations: &mut Violations) {
    match (spec.replicas, spec.every_node) {
        (None, false) => {
            violations
                .required("spec.replicas")
                .suggest("how many tasks there should be; or everyNode: true");
        }
        (Some(_), true) => {
            violations
                .forbidden("spec.replicas", "means nothing with everyNode")
                .suggest("keep one of them");
        }
        _ => {}
    }
    selector_rules(spec, violations);
    template_rules(spec, violations);
    let rollout = &spec.rollout;
    if rollout.max_unavailable.is_zero() {
        violations
            .invalid("spec.rollout.maxUnavailable", "0 lets no task be changed")
            .suggest("at least 1: an old task ends before the next one begins");
    }
    if rollout.progress_deadline_seconds <= spec.min_ready_seconds {
        violations
            .invalid(
                "spec.rollout.progressDeadlineSeconds",
                format!(
                    "{} passes before a task can be available",
                    rollout.progress_deadline_seconds
                ),
            )
            .suggest(format!("more than minReadySeconds, {}", spec.min_ready_seconds));
    }
    let lost = &spec.on_unreachable;
    if lost.policy == UnreachablePolicy::Wait && lost.after.is_some() {
        violations
            .forbidden("spec.onUnreachable.after", "means nothing with the policy Wait")
            .suggest("leave it out, or set policy: Replace");
    }
    if lost.policy == UnreachablePolicy::Replace && spec.every_node {
        violations
            .invalid("spec.onUnreachable.policy", "a task of every node has no other node to go to")
            .suggest("leave it out, or set Wait");
    }
}

fn selector_rules(spec: &TaskSetSpec, violations: &mut Violations) {
    let Some(selector) = &spec.selector else { return };
    selector.validate("spec.selector", violations);
    if selector.is_empty() {
        violations
            .invalid("spec.selector", "selects every task of the namespace")
            .suggest("leave it out, or name labels of the template");
    } else if !selector.matches(&spec.template.metadata.labels) {
        violations
            .invalid(
                "spec.template.metadata.labels",
                format!("do not match the selector {selector}"),
            )
            .suggest("give the template the labels that spec.selector names");
    }
}

/// The rules of tasks, and those that only a template has.
fn template_rules(spec: &TaskSetSpec, violations: &mut Violations) {
    let template = &spec.template.spec;
    let mut of_task = Violations::new();
    // What a template says of it is refused below, whatever it says.
    task_rules::rules(&TaskSpec { reschedule: None, ..template.clone() }, &mut of_task);
    violations.append(of_task.below("spec", "spec.template.spec"));
    if template.restart_policy != RestartPolicy::Always {
        violations
            .not_supported(
                "spec.template.spec.restartPolicy",
                "a TaskSet keeps its tasks running, so they start again whenever they end",
            )
            .suggest("leave it out, or set Always; what should end once is a Task");
    }
    if template.reschedule.is_some() {
        violations
            .forbidden(
                "spec.template.spec.reschedule",
                "a TaskSet puts another task in the place of one that has ended, itself",
            )
            .suggest("leave it out");
    }
    let placement = &template.placement;
    if placement.prefer.is_some() {
        violations
            .forbidden("spec.template.spec.placement.prefer", "is set by the rollout")
            .suggest("leave it out");
    }
    check_labels(&spec.template.metadata.labels, "spec.template.metadata.labels", violations);
    for own in [SET_LABEL, REVISION_LABEL] {
        if spec.template.metadata.labels.contains_key(own) {
            let path = member_path("spec.template.metadata.labels", own);
            violations.forbidden(path, "is set by the controller").suggest("leave it out");
        }
    }
    if !spec.every_node {
        return;
    }
    let given = [("at", placement.at.is_some()), ("node", placement.node.is_some())];
    for (field, _) in given.into_iter().filter(|(_, given)| *given) {
        violations
            .forbidden(
                format!("spec.template.spec.placement.{field}"),
                "means nothing with everyNode: each node that matches gets a task",
            )
            .suggest("leave it out; `on`, `selector` and `tolerations` say which nodes match");
    }
}

/// What may not change while the set exists.
pub(super) fn change_rules(old: &Value, new: &Value, violations: &mut Violations) {
    let spec = |object: &Value| object.get("spec").cloned().unwrap_or_default();
    let (old, new) = (spec(old), spec(new));
    if old.get("selector") != new.get("selector") {
        violations
            .forbidden("spec.selector", "cannot change while the set exists")
            .suggest("delete the set with --cascade=orphan and create it again");
    }
    let every = |spec: &Value| spec.get("everyNode").and_then(Value::as_bool).unwrap_or(false);
    if every(&old) != every(&new) {
        violations
            .forbidden("spec.everyNode", "cannot change while the set exists")
            .suggest("make another set");
    }
}
