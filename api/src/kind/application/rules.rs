//! What no Application may be, and what of one may not change: everything that could never be correct, whatever the
//! network does.

use serde_json::Value;

use super::pin::pins;
use super::{ApplicationSpec, Connection, Part, Runs, Signal};
use crate::kind::admit_spec;
use crate::kind::task::{NodeChoice, RestartPolicy, rules as task_rules};
use crate::name::check_name;
use crate::selector::check_labels;
use crate::validate::{Violations, did_you_mean, element_path, member_path};

/// More parts than any graph of ROS nodes has; a decision over them still takes less than a period.
const MAX_PARTS: usize = 200;
/// The task of a part is called APPLICATION-PART-NUMBER (see [`super::task_name`]), and that is a name and a label.
const MAX_APPLICATION_NAME: usize = 34;
const MAX_PART_NAME: usize = 22;

pub(super) fn admit_body(object: &mut Value, violations: &mut Violations) {
    let name = object.pointer("/metadata/name").and_then(Value::as_str);
    if let Some(name) = name.filter(|n| n.len() > MAX_APPLICATION_NAME) {
        violations
            .invalid(
                "metadata.name",
                format!("is {} bytes long, at most {MAX_APPLICATION_NAME} are allowed", name.len()),
            )
            .suggest("the names of its tasks begin with it and are longer");
    }
    fill_restart_policies(object);
    admit_spec::<ApplicationSpec>(object, violations, rules);
}

/// A part that runs once starts again only when it failed; the others whenever they end.
fn fill_restart_policies(object: &mut Value) {
    let parts = object.pointer_mut("/spec/parts").and_then(Value::as_array_mut);
    for part in parts.into_iter().flatten() {
        let once = part.get("runs").and_then(Value::as_str) == Some("Once");
        if let Some(spec) = part.pointer_mut("/template/spec").and_then(Value::as_object_mut) {
            let policy = if once { "OnFailure" } else { "Always" };
            spec.entry("restartPolicy").or_insert_with(|| policy.into());
        }
    }
}

fn rules(spec: &ApplicationSpec, violations: &mut Violations) {
    if let Err(error) = check_name(&spec.home) {
        violations
            .invalid("spec.home", error.to_string())
            .suggest("the name of the robot's Node, `muster get nodes` lists them");
    }
    scale_rules(spec, violations);
    if spec.parts.is_empty() {
        violations.required("spec.parts").suggest("at least one part");
    }
    if spec.parts.len() > MAX_PARTS {
        let reason = format!("are {}, at most {MAX_PARTS} are allowed", spec.parts.len());
        violations.invalid("spec.parts", reason).suggest("make several Applications");
    }
    for (i, part) in spec.parts.iter().enumerate() {
        part_rules(spec, i, part, violations);
    }
    for (i, connection) in spec.connections.iter().enumerate() {
        connection_rules(spec, i, connection, violations);
    }
    for (i, signal) in spec.signals.iter().enumerate() {
        signal_rules(spec, i, signal, violations);
    }
    objective_rules(spec, violations);
    time_rules(spec, violations);
}

fn scale_rules(spec: &ApplicationSpec, violations: &mut Violations) {
    for (i, node) in spec.scales.nodes.iter().enumerate() {
        let path = element_path("spec.scales.nodes", i);
        if let Err(error) = check_name(node) {
            violations.invalid(&path, error.to_string());
        }
        if *node == spec.home {
            violations
                .invalid(&path, "is home, where parts run anyway")
                .suggest("leave it out, or name another node");
        }
        if spec.scales.nodes[..i].contains(node) {
            violations.duplicate(path, format!("{node:?} is there twice"));
        }
    }
    if let Some(selector) = &spec.scales.selector {
        selector.validate("spec.scales.selector", violations);
    }
    for (node, gain) in &spec.scales.gains {
        let path = member_path("spec.scales.gains", node);
        if !(*gain > 0.0 && gain.is_finite()) {
            violations
                .invalid(&path, format!("{gain} is not what a millicore is worth"))
                .suggest("a number above 0; home has 1");
        }
        named_scale(spec, node, &path, violations);
    }
}

/// A scale that is named by itself, while the others are named in a list, is a slip of the pen when it is not there.
fn named_scale(spec: &ApplicationSpec, node: &str, path: &str, violations: &mut Violations) {
    if node == spec.home {
        violations
            .invalid(path, "is home")
            .suggest("what is so at home needs no name: leave it out");
    } else if spec.scales.selector.is_none()
        && !spec.scales.nodes.is_empty()
        && !spec.scales.nodes.iter().any(|n| n == node)
    {
        violations
            .not_supported(path, format!("{node:?} is none of spec.scales.nodes"))
            .suggestion = did_you_mean(node, spec.scales.nodes.iter().map(String::as_str));
    }
}

fn part_rules(spec: &ApplicationSpec, i: usize, part: &Part, violations: &mut Violations) {
    let path = element_path("spec.parts", i);
    let at = |field: &str| format!("{path}.{field}");
    match check_name(&part.name) {
        Err(error) => {
            let near = error.suggestion().map(|s| format!("try {s:?}"));
            violations.invalid(at("name"), error.to_string()).suggestion = near;
        }
        Ok(()) if part.name.len() > MAX_PART_NAME => {
            let reason =
                format!("is {} bytes long, at most {MAX_PART_NAME} are allowed", part.name.len());
            violations.invalid(at("name"), reason);
        }
        Ok(()) => {}
    }
    if spec.parts[..i].iter().any(|p| p.name == part.name) {
        violations.duplicate(at("name"), format!("there are two parts {:?}", part.name));
    }
    match (part.runs, part.duty) {
        (Runs::Sometimes, Some(duty)) if !(duty > 0.0 && duty <= 1.0) => {
            violations
                .invalid(at("duty"), format!("{duty} is not a share of the time"))
                .suggest("above 0, at most 1");
        }
        (Runs::Always | Runs::Once, Some(_)) => {
            violations
                .forbidden(at("duty"), "means nothing of a part that does not run Sometimes")
                .suggest("leave it out, or set runs: Sometimes");
        }
        _ => {}
    }
    if !(part.gain >= 0.0 && part.gain.is_finite()) {
        violations
            .invalid(at("gain"), format!("{} is not a factor", part.gain))
            .suggest("0 or more; 1 is usual");
    }
    if !(0.0..=1.0).contains(&part.home_accuracy) {
        violations
            .invalid(at("homeAccuracy"), format!("{} is not a share", part.home_accuracy))
            .suggest("0 to 1");
    }
    for node in part.cpu_on.keys() {
        named_scale(spec, node, &member_path(&at("cpuOn"), node), violations);
    }
    template_rules(part, &at("template"), violations);
}

/// The rules of tasks, and those of a task whose place is decided with others.
fn template_rules(part: &Part, path: &str, violations: &mut Violations) {
    let task = &part.template.spec;
    let mut of_task = Violations::new();
    task_rules::rules(task, &mut of_task);
    violations.append(of_task.below("spec", &format!("{path}.spec")));
    let labels = &part.template.metadata.labels;
    check_labels(labels, &format!("{path}.metadata.labels"), violations);
    let placement = &task.placement;
    let given = [
        ("at", placement.at.is_some()),
        ("node", placement.node.is_some()),
        ("prefer", placement.prefer.is_some()),
        ("apart", placement.apart.is_some()),
        ("on", placement.on != NodeChoice::Any),
    ];
    for (field, _) in given.into_iter().filter(|(_, given)| *given) {
        violations
            .forbidden(
                format!("{path}.spec.placement.{field}"),
                "is decided by the Application: at home, or on one of its scales",
            )
            .suggest("leave it out; spec.home and spec.scales say where parts may run");
    }
    let given = [
        (
            "standby",
            task.standby.is_some(),
            "what stands by for a part is the Application's to say",
        ),
        (
            "reschedule",
            task.reschedule.is_some(),
            "where a part is tried is decided by the Application",
        ),
        (
            "ttlSecondsAfterFinished",
            task.ttl_seconds_after_finished.is_some(),
            "a part whose task is gone is begun again",
        ),
    ];
    for (field, _, why) in given.into_iter().filter(|(_, given, _)| *given) {
        violations.forbidden(format!("{path}.spec.{field}"), why).suggest("leave it out");
    }
    let wanted = match part.runs {
        Runs::Once if task.restart_policy == RestartPolicy::Always => "OnFailure",
        Runs::Always if task.restart_policy != RestartPolicy::Always => "Always",
        _ => return,
    };
    violations
        .not_supported(
            format!("{path}.spec.restartPolicy"),
            format!("{:?} is not how a part runs {:?}", task.restart_policy, part.runs),
        )
        .suggest(format!("leave it out, or set {wanted}"));
}

fn connection_rules(
    spec: &ApplicationSpec,
    i: usize,
    connection: &Connection,
    violations: &mut Violations,
) {
    let path = element_path("spec.connections", i);
    let at = |field: &str| format!("{path}.{field}");
    if connection.topic.trim().is_empty() {
        violations.required(at("topic")).suggest("for example \"/scan\"");
    }
    for (field, name) in [("from", &connection.from), ("to", &connection.to)] {
        known_part(spec, name, &at(field), violations);
    }
    if connection.from == connection.to {
        violations.invalid(at("to"), "is the part that publishes").suggest("name another part");
    }
    let same = |c: &Connection| {
        (&c.topic, &c.from, &c.to) == (&connection.topic, &connection.from, &connection.to)
    };
    if spec.connections[..i].iter().any(same) {
        violations.duplicate(&path, format!("{:?} is there twice", connection.topic));
    }
    for (field, hz) in [("minHz", connection.min_hz), ("optHz", connection.opt_hz)] {
        if let Some(hz) = hz.filter(|hz| !(*hz > 0.0 && hz.is_finite())) {
            violations
                .invalid(at(field), format!("{hz} is not a frequency"))
                .suggest("messages a second, above 0; leave it out where none is expected");
        }
    }
    if let (Some(min), Some(opt)) = (connection.min_hz, connection.opt_hz)
        && opt < min
    {
        violations
            .invalid(at("optHz"), format!("{opt} is less than minHz, {min}"))
            .suggest("minHz is the threshold, optHz what serves best");
    }
    frequency_rules(spec, connection, &path, violations);
}

/// Whether its frequency can be kept by anything that could be done.
fn frequency_rules(
    spec: &ApplicationSpec,
    connection: &Connection,
    path: &str,
    violations: &mut Violations,
) {
    let once = |name: &str| spec.part(name).is_some_and(|p| p.runs == Runs::Once);
    match connection.min_hz {
        Some(_) if once(&connection.from) => {
            violations
                .forbidden(format!("{path}.minHz"), "a part that runs once has no frequency")
                .suggest("leave it out");
        }
        Some(_) => {}
        None if once(&connection.from) || once(&connection.to) => return,
        None => {
            violations
                .required(format!("{path}.minHz"))
                .suggest("the lowest frequency with which the application works, in Hz");
        }
    }
    let tolerance = connection.tolerance.as_duration();
    if !tolerance.is_zero() && tolerance <= spec.return_time.as_duration() {
        violations
            .invalid(
                format!("{path}.tolerance"),
                format!(
                    "{} is over before a part is back home, which takes {}",
                    connection.tolerance, spec.return_time
                ),
            )
            .suggest("0s keeps its parts at home; or lower spec.returnTime if they start faster");
    }
}

fn known_part(spec: &ApplicationSpec, name: &str, path: &str, violations: &mut Violations) {
    if spec.part(name).is_none() {
        let names = spec.parts.iter().map(|p| p.name.as_str());
        violations.not_supported(path, format!("{name:?} is not a part")).suggestion =
            did_you_mean(name, names);
    }
}

fn signal_rules(spec: &ApplicationSpec, i: usize, signal: &Signal, violations: &mut Violations) {
    let path = element_path("spec.signals", i);
    let at = |field: &str| format!("{path}.{field}");
    if signal.name.trim().is_empty() {
        violations.required(at("name"));
    }
    if spec.signals[..i].iter().any(|s| s.name == signal.name) {
        violations.duplicate(at("name"), format!("there are two signals {:?}", signal.name));
    }
    match (signal.min, signal.max) {
        (None, None) => {
            violations.required(at("max")).suggest("a limit: max, min or both");
        }
        (Some(min), Some(max)) if min >= max => {
            violations.invalid(at("min"), format!("{min} leaves nothing below max, {max}"));
        }
        _ => {}
    }
    for (j, name) in signal.parts.iter().enumerate() {
        let path = element_path(&at("parts"), j);
        known_part(spec, name, &path, violations);
        if let Some(pin) = spec.part(name).and_then(|part| pins(spec, part).into_iter().next()) {
            violations
                .invalid(path, format!("{name} is always at home: {pin}"))
                .suggest("name parts that may be away, or none for all of them");
        }
    }
    let tolerance = signal.tolerance.as_duration();
    if tolerance <= spec.return_time.as_duration() {
        violations
            .invalid(
                at("tolerance"),
                format!(
                    "{} is over before a part is back home, which takes {}",
                    signal.tolerance, spec.return_time
                ),
            )
            .suggest("more than spec.returnTime");
    }
}

fn objective_rules(spec: &ApplicationSpec, violations: &mut Violations) {
    let objective = &spec.objective;
    let weights = [
        ("cpu", objective.cpu),
        ("latency", objective.latency),
        ("energy", objective.energy),
        ("accuracy", objective.accuracy),
    ];
    for (field, weight) in weights.into_iter().chain([("hysteresis", objective.hysteresis)]) {
        if !(weight >= 0.0 && weight.is_finite()) {
            violations
                .invalid(format!("spec.objective.{field}"), format!("{weight} is not a weight"))
                .suggest("0 or more");
        }
    }
    if weights.iter().all(|(_, weight)| *weight == 0.0) {
        violations
            .invalid("spec.objective", "every weight is 0, so no mapping is better than another")
            .suggest("leave it out for cpu: 1, or set policy: Home");
    }
}

fn time_rules(spec: &ApplicationSpec, violations: &mut Violations) {
    for (field, span) in
        [("period", spec.period), ("cooldown", spec.cooldown), ("returnTime", spec.return_time)]
    {
        if span.as_duration().is_zero() {
            violations
                .invalid(format!("spec.{field}"), "0s is no time")
                .suggest("for example \"1s\"");
        }
    }
    if spec.cooldown.as_duration() < spec.period.as_duration() {
        violations
            .invalid(
                "spec.cooldown",
                format!("{} is over at the next look, after {}", spec.cooldown, spec.period),
            )
            .suggest("several periods, or parts go to and fro");
    }
}

/// What may not change while the application exists.
pub(super) fn change_rules(old: &Value, new: &Value, violations: &mut Violations) {
    if old.pointer("/spec/home") != new.pointer("/spec/home") {
        violations
            .forbidden("spec.home", "cannot change while the application exists")
            .suggest("another robot has an Application of its own");
    }
}
