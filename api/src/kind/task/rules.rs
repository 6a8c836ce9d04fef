//! What no Task may be, and what of one may not change.

use serde_json::Value;

use super::{
    Cost, DisconnectPolicy, EnvVar, MAX_GRACE_SECONDS, NodeChoice, OnDisconnect, Resources,
    RestartPolicy, Run, StopSignal, TaskSpec, TolerationOperator,
};
use crate::name::check_name;
use crate::quantity::{Bytes, MilliCpu};
use crate::validate::{Violations, element_path, member_path};

/// The rules beside those that the types hold.
pub(in crate::kind) fn rules(spec: &TaskSpec, violations: &mut Violations) {
    placement_rules(spec, violations);
    resource_rules(&spec.resources, violations);
    run_rules(&spec.run, violations);
    super::ros::rules(spec, violations);
    super::probe::rules(spec, violations);
    super::depend::rules(spec, violations);
    super::reschedule::rules(spec, violations);
    if spec.run.executor.is_some() && spec.restart_policy != RestartPolicy::Never {
        violations
            .invalid("spec.restartPolicy", "an executor's work is not run again by itself")
            .suggest("leave it out, or set Never");
    }
    if spec.run.executor.is_some() && spec.stop_signal != StopSignal::default() {
        violations
            .forbidden("spec.stopSignal", "an executor ends its work as it likes")
            .suggest("leave it out");
    }
    if spec.active_deadline_seconds == Some(0) {
        violations
            .invalid("spec.activeDeadlineSeconds", "0 lets nothing run")
            .suggest("leave it out for no deadline");
    }
    if spec.grace_period_seconds > MAX_GRACE_SECONDS {
        let reason = format!(
            "{} is more than the longest allowed, {MAX_GRACE_SECONDS}",
            spec.grace_period_seconds
        );
        violations.invalid("spec.gracePeriodSeconds", reason);
    }
    if let Some(OnDisconnect { policy: DisconnectPolicy::Keep, after: Some(_) }) =
        spec.on_disconnect
    {
        violations
            .forbidden("spec.onDisconnect.after", "means nothing with the policy Keep")
            .suggest("leave it out, or set policy: Stop");
    }
    standby_rules(spec, violations);
}

/// What stands by begins without the controller's word: nothing may depend on who else runs meanwhile.
fn standby_rules(spec: &TaskSpec, violations: &mut Violations) {
    let Some(standby) = &spec.standby else { return };
    if standby.after.as_duration().is_zero() {
        violations
            .invalid("spec.standby.after", "0s lets it stand by for no time")
            .suggest("leave spec.standby out, or name a time without contact, such as \"10s\"");
    }
    if !spec.resources.actuators.is_empty() {
        violations
            .forbidden("spec.standby", "a task with actuators would keep them from everybody")
            .suggest("leave it out: a lease passes on when its holder ends");
    }
    if spec.run.executor.is_some() {
        violations
            .forbidden("spec.standby", "an executor begins its work when it is given it")
            .suggest("leave it out");
    }
}

fn placement_rules(spec: &TaskSpec, violations: &mut Violations) {
    let placement = &spec.placement;
    if let Some(percent) = placement.min_battery.filter(|percent| *percent > 100) {
        violations
            .invalid("spec.placement.minBattery", format!("{percent} is more than a full battery"))
            .suggest("percent, 0 to 100");
    }
    if let Some(cost) = placement.battery_cost {
        if !(cost >= 0.0 && cost.is_finite()) {
            violations
                .invalid("spec.placement.batteryCost", format!("{cost} adds nothing to a score"))
                .suggest("metres or seconds for each percent, 0 or more; try 0.1");
        } else if placement.at.is_none() {
            violations
                .invalid("spec.placement.batteryCost", "there is no score to add to")
                .suggest("`batteryCost` needs an operation position: at: {x: 3.0, y: 4.0}");
        }
    }
    if let Some(within) = placement.within {
        if !(within >= 0.0 && within.is_finite()) {
            violations
                .invalid("spec.placement.within", format!("{within} is not a radius in metres"));
        }
        if placement.at.is_none() {
            violations
                .required("spec.placement.at")
                .suggest("`within` needs the position it is around: at: {x: 3.0, y: 4.0}");
        }
    }
    if let Some(at) = &placement.at {
        for (axis, value) in [("x", at.x), ("y", at.y), ("z", at.z)] {
            if !value.is_finite() {
                violations.invalid(
                    format!("spec.placement.at.{axis}"),
                    format!("{value} is not a number of metres"),
                );
            }
        }
    }
    if placement.cost == Cost::TravelTime && placement.at.is_none() {
        violations
            .required("spec.placement.at")
            .suggest("the cost TravelTime needs the position to travel to");
    }
    if placement.on == NodeChoice::Cloud && !spec.resources.is_compute_only() {
        violations
            .invalid(
                "spec.placement.on",
                "a Cloud node has no sensors or actuators, and the task asks for some",
            )
            .suggest("set on: Robot");
    }
    for (field, name) in
        [("node", &placement.node), ("prefer", &placement.prefer), ("apart", &placement.apart)]
    {
        if let Some(Err(error)) = name.as_deref().map(check_name) {
            violations.invalid(format!("spec.placement.{field}"), error.to_string());
        }
    }
    placement.selector.validate("spec.placement.selector", violations);
    for (i, toleration) in placement.tolerations.iter().enumerate() {
        let path = element_path("spec.placement.tolerations", i);
        if toleration.key.is_empty() && toleration.operator == TolerationOperator::Equal {
            violations
                .required(format!("{path}.key"))
                .suggest("or set operator: Exists to tolerate every taint");
        }
        if !toleration.value.is_empty() && toleration.operator == TolerationOperator::Exists {
            violations.forbidden(format!("{path}.value"), "means nothing with the operator Exists");
        }
    }
}

/// Below this a memory limit kills any program while it starts; Docker refuses less, too.
const MIN_MEMORY: Bytes = Bytes(6 << 20);
/// The kernel gives no quota finer than 1 ms in a period of 100 ms.
const MIN_CPU: MilliCpu = MilliCpu(10);

fn resource_rules(resources: &Resources, violations: &mut Violations) {
    if let Some(cpu) = resources.cpu.filter(|c| *c < MIN_CPU) {
        violations
            .invalid(
                "spec.resources.cpu",
                format!("{cpu} is less than the smallest quota, {MIN_CPU}"),
            )
            .suggest("leave it out to reserve nothing");
    }
    if let Some(memory) = resources.memory.filter(|m| *m < MIN_MEMORY) {
        violations
            .invalid(
                "spec.resources.memory",
                format!("{memory} is less than any program needs, {MIN_MEMORY}"),
            )
            .suggest(format!("did you mean {:?}?", format!("{}Mi", memory.0.max(6))));
    }
    if resources.pids == Some(0) {
        violations.invalid("spec.resources.pids", "0 lets nothing run");
    }
    if let Some(io) = &resources.io {
        for (field, limit) in [("readBps", io.read_bps), ("writeBps", io.write_bps)] {
            if limit == Some(Bytes(0)) {
                violations
                    .invalid(format!("spec.resources.io.{field}"), "0 lets nothing through")
                    .suggest("leave it out for no limit");
            }
        }
    }
    for (field, functions) in [("sensors", &resources.sensors), ("actuators", &resources.actuators)]
    {
        for (i, function) in functions.iter().enumerate() {
            if functions[..i].contains(function) {
                violations.duplicate(
                    element_path(&member_path("spec.resources", field), i),
                    format!("{:?} is there twice", function.to_string()),
                );
            }
        }
    }
}

fn run_rules(run: &Run, violations: &mut Violations) {
    let given: Vec<&str> = [
        ("container", run.container.is_some()),
        ("process", run.process.is_some()),
        ("executor", run.executor.is_some()),
    ]
    .into_iter()
    .filter_map(|(name, given)| given.then_some(name))
    .collect();
    match given.as_slice() {
        [] => {
            violations.required("spec.run").suggest("give `container` or `process`");
        }
        [_] => {}
        [first, second, ..] => {
            violations
                .forbidden("spec.run", format!("has both `{first}` and `{second}`"))
                .suggest("keep one of them");
            return;
        }
    }
    if let Some(container) = &run.container {
        if container.image.trim().is_empty() {
            violations.required("spec.run.container.image");
        }
        env_rules(&container.env, "spec.run.container.env", violations);
        super::config::rules(run, "spec.run.container", violations);
        absolute("spec.run.container.workingDir", container.working_dir.as_deref(), violations);
        for (i, mount) in container.mounts.iter().enumerate() {
            let path = element_path("spec.run.container.mounts", i);
            absolute(&format!("{path}.hostPath"), Some(&mount.host_path), violations);
            absolute(&format!("{path}.mountPath"), Some(&mount.mount_path), violations);
        }
        if let Some(user) = container.user.as_deref().filter(|user| !is_numbers(user)) {
            violations
                .invalid("spec.run.container.user", format!("{user:?} is no UID or UID:GID"))
                .suggest("for example \"1000\"; names mean something inside of an image only");
        }
    }
    if let Some(process) = &run.process {
        if process.command.first().is_none_or(|c| c.is_empty()) {
            violations
                .required("spec.run.process.command")
                .suggest("for example [\"/usr/bin/env\"]");
        }
        env_rules(&process.env, "spec.run.process.env", violations);
        super::config::rules(run, "spec.run.process", violations);
        absolute("spec.run.process.workingDir", process.working_dir.as_deref(), violations);
    }
    if let Some(executor) = &run.executor
        && let Err(error) = check_name(&executor.task)
    {
        violations.invalid("spec.run.executor.task", error.to_string());
    }
}

/// `UID` or `UID:GID`.
fn is_numbers(user: &str) -> bool {
    let (uid, gid) = user.split_once(':').unwrap_or((user, "0"));
    [uid, gid]
        .into_iter()
        .all(|id| id.bytes().all(|b| b.is_ascii_digit()) && id.parse::<i32>().is_ok())
}

fn absolute(path: &str, given: Option<&str>, violations: &mut Violations) {
    if let Some(given) = given.filter(|g| !g.starts_with('/')) {
        violations
            .invalid(path, format!("{given:?} is not an absolute path"))
            .suggest("begin it with '/'");
    }
}

fn env_rules(env: &[EnvVar], path: &str, violations: &mut Violations) {
    for (i, var) in env.iter().enumerate() {
        let path = format!("{}.name", element_path(path, i));
        if var.name.is_empty() || var.name.contains(['=', '\0']) {
            violations.invalid(&path, format!("{:?} is not the name of a variable", var.name));
        }
        if env[..i].iter().any(|v| v.name == var.name) {
            violations.duplicate(path, format!("{:?} is there twice", var.name));
        }
    }
}

/// What of a spec may change while the task exists: nothing that would need another process.
const MUTABLE: [&str; 4] =
    ["priority", "gracePeriodSeconds", "activeDeadlineSeconds", "ttlSecondsAfterFinished"];

/// What may not change while the task exists.
pub(super) fn change_rules(old: &Value, new: &Value, violations: &mut Violations) {
    let empty = serde_json::Map::new();
    let spec =
        |object: &Value| object.get("spec").and_then(Value::as_object).cloned().unwrap_or_default();
    let (mut old, mut new) = (spec(old), spec(new));
    if !new.contains_key("standby") {
        old.remove("standby");
    }
    for spec in [&mut old, &mut new] {
        spec.retain(|key, _| !MUTABLE.contains(&key.as_str()));
        if let Some(placement) = spec.get_mut("placement").and_then(Value::as_object_mut) {
            placement.remove("tolerations");
        }
    }
    differences(&Value::Object(old), &Value::Object(new), "spec", &empty, violations);
}

/// Names the deepest fields that differ, so that the message points at what was changed.
fn differences(
    old: &Value,
    new: &Value,
    path: &str,
    empty: &serde_json::Map<String, Value>,
    violations: &mut Violations,
) {
    if old == new {
        return;
    }
    let as_members = |v: &Value| match v {
        Value::Object(members) => Some(members.clone()),
        Value::Null => Some(empty.clone()),
        _ => None,
    };
    match (as_members(old), as_members(new)) {
        (Some(a), Some(b)) if !(a.is_empty() && b.is_empty()) => {
            let keys: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
            for key in keys {
                let null = Value::Null;
                let (a, b) = (a.get(key).unwrap_or(&null), b.get(key).unwrap_or(&null));
                differences(a, b, &member_path(path, key), empty, violations);
            }
        }
        _ => {
            violations
                .forbidden(path, "cannot change while the task exists")
                .suggest("delete the task and create it again; only priority, gracePeriodSeconds, activeDeadlineSeconds, ttlSecondsAfterFinished and placement.tolerations may change");
        }
    }
}
