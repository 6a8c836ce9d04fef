//! A task: what it is, where it may run, what it needs and has, why it waits.

use jiff::Timestamp;
use muster_api::kind::task::depend::DependsOn;
use muster_api::kind::task::{
    ContainerRun, EnvFrom, EnvVar, Files, OutOfRange, Placement, ProcessNetwork, ProcessRun,
    Reschedule, Resources, RosSpec, Task, TaskSpec, TaskStatus,
};

use super::{begin, position, scored_by, when, which_node};
use crate::command::why::{refusal_table, tries_table};
use crate::output::columns::task as columns;
use crate::output::human;
use crate::output::sheet::Sheet;
use crate::output::style::Mood;
use crate::output::table::Cell;

pub(super) fn describe(sheet: &mut Sheet, task: &Task, now: Timestamp) {
    begin(sheet, &task.metadata, now);
    let status = task.status.clone().unwrap_or_default();
    state(sheet, task, &status, now);
    placement(sheet, &task.spec.placement);
    sheet.list("Depends on", task.spec.depends_on.iter().map(dependency));
    resources(sheet, &task.spec.resources, &status);
    program(sheet, &task.spec);
    super::probes::describe(sheet, &task.spec, &status);
    if !status.earlier.is_empty() {
        sheet.table("Tried before", tries_table(&status.earlier));
    }
    if !status.why.is_empty() {
        sheet.table("Why it waits", refusal_table(&status.why));
    }
}

fn state(sheet: &mut Sheet, task: &Task, status: &TaskStatus, now: Timestamp) {
    sheet.field("Phase", Cell::new(status.phase.as_str(), columns::mood(status.phase)));
    let some = |text: &String| Some(text.clone()).filter(|t| !t.is_empty());
    sheet.maybe("Reason", some(&status.reason));
    sheet.maybe("Message", some(&status.message));
    sheet.field("Class", task.spec.resources.class());
    sheet.field("Priority", task.spec.priority.to_string());
    sheet.maybe("Node", status.node.clone());
    sheet.maybe("Nominated", status.nominated_node.clone());
    sheet.maybe("To end", status.stop.as_ref().map(|s| format!("{}: {}", s.reason, s.message)));
    let seconds = |seconds: u32| format!("{seconds} s");
    sheet.maybe("Deadline", task.spec.active_deadline_seconds.map(seconds));
    sheet.maybe("ROS", task.spec.ros.as_ref().map(ros));
    let standby = task.spec.standby.map(|standby| standby.after);
    let standby = standby.map(|after| format!("until its node had no contact for {after}"));
    sheet.maybe("Stands by", standby);
    sheet.maybe("Kept after its end", task.spec.ttl_seconds_after_finished.map(seconds));
    let cost = task.spec.placement.cost;
    sheet.maybe("Score", status.score.map(|s| columns::score(s, cost)));
    sheet.maybe("Lease", status.lease.as_ref().map(|l| format!("{}, epoch {}", l.name, l.epoch)));
    sheet.maybe("Attempt", some(&columns::attempts(&task.spec, status)));
    let reschedule = task.spec.reschedule.as_ref();
    sheet.maybe("Tried elsewhere", reschedule.map(tried_elsewhere));
    sheet.maybe("Not before", status.not_before.as_ref().map(|t| when(t.0, now)));
    sheet.maybe("Placed", status.bound_at.as_ref().map(|t| when(t.0, now)));
    sheet.maybe("Ready", ready(status));
    sheet.maybe("Started", status.started_at.as_ref().map(|t| when(t.0, now)));
    sheet.maybe("Ended", status.finished_at.as_ref().map(|t| when(t.0, now)));
    sheet.maybe("Exit", some(&columns::exit(status)));
}

/// `up to 3 attempts, after 10s, doubled up to 5m`.
fn tried_elsewhere(block: &Reschedule) -> String {
    let Reschedule { max_attempts, attempts_per_node, backoff, max_backoff } = block;
    let each = match attempts_per_node {
        1 => String::new(),
        n => format!(", {n} on a node"),
    };
    format!("up to {max_attempts} attempts{each}, after {backoff}, doubled up to {max_backoff}")
}

/// `camera (Ready, restarts with it)`.
fn dependency(on: &DependsOn) -> String {
    let restarts = if on.restart { ", restarts with it" } else { "" };
    format!("{} ({:?}{restarts})", on.task, on.condition)
}

/// Of a running task: whether it serves.
fn ros(ros: &RosSpec) -> String {
    let namespace = ros.namespace.as_ref().map(|namespace| format!(", in {namespace}"));
    let own = if ros.is_view() { "a master of its own" } else { "the node's master" };
    let master = ros.uri().unwrap_or(own);
    format!("{master}{}", namespace.unwrap_or_default())
}

fn ready(status: &TaskStatus) -> Option<Cell> {
    let word = columns::ready(status)?;
    Some(Cell::new(word, if status.is_ready() { Mood::Good } else { Mood::Warn }))
}

fn placement(sheet: &mut Sheet, placement: &Placement) {
    sheet.heading("Placement");
    if let Some(at) = &placement.at {
        let mut text = position(at);
        if let Some(within) = placement.within {
            text.push_str(&format!(", within {within} m"));
        }
        if placement.on_out_of_range == OutOfRange::Reschedule {
            text.push_str("; is placed anew when its robot leaves it");
        }
        sheet.field("At", text);
        sheet.field("Scored by", scored_by(placement.cost));
    }
    sheet.field("On", which_node(placement.on));
    sheet.maybe("Pinned to", placement.node.clone());
    if !placement.selector.is_empty() {
        sheet.field("With labels", placement.selector.to_string());
    }
    let tolerations = placement.tolerations.iter().map(|t| {
        let effect = t.effect.map_or_else(|| "every effect".to_owned(), |e| format!("{e:?}"));
        match (t.key.is_empty(), t.value.is_empty()) {
            (true, _) => format!("every taint, {effect}"),
            (false, true) => format!("{}, {effect}", t.key),
            (false, false) => format!("{}={}, {effect}", t.key, t.value),
        }
    });
    sheet.list("Tolerates", tolerations);
}

fn resources(sheet: &mut Sheet, resources: &Resources, status: &TaskStatus) {
    sheet.heading("Resources");
    let usage = status.usage.as_ref();
    let with_use = |limit: Option<String>, used: Option<String>| {
        let limit = limit.unwrap_or_else(|| "none reserved".to_owned());
        match used {
            Some(used) => format!("{limit} (uses {used})"),
            None => limit,
        }
    };
    sheet.field(
        "Cpu",
        with_use(resources.cpu.map(human::cores), usage.map(|u| human::cores(u.cpu))),
    );
    let memory = resources.memory.map(human::bytes);
    sheet.field("Memory", with_use(memory, usage.map(|u| human::bytes(u.memory))));
    sheet.list("Extended", resources.extended.iter().map(|(name, n)| format!("{name}: {n}")));
    if let Some(io) = &resources.io {
        sheet.maybe("Reads", io.read_bps.map(|b| format!("{}/s at most", human::bytes(b))));
        sheet.maybe("Writes", io.write_bps.map(|b| format!("{}/s at most", human::bytes(b))));
    }
    sheet.maybe("Processes", resources.pids.map(|n| format!("{n} at most")));
    sheet.list("Sensors", resources.sensors.iter().map(ToString::to_string));
    sheet.list("Actuators", resources.actuators.iter().map(ToString::to_string));
}

fn program(sheet: &mut Sheet, spec: &TaskSpec) {
    sheet.heading("Program");
    if let Some(container) = &spec.run.container {
        of_container(sheet, container);
    }
    if let Some(process) = &spec.run.process {
        of_process(sheet, process);
    }
    sheet.field("Restarts", format!("{:?}", spec.restart_policy));
    let (signal, grace) = (spec.stop_signal.name(), spec.grace_period_seconds);
    sheet.field("Stop", format!("{signal}, SIGKILL after {grace}s"));
    let without_contact = match spec.stop_after_disconnect() {
        Some(after) => format!("stops after {after}"),
        None => "goes on".to_owned(),
    };
    sheet.field("If cut off", without_contact);
}

fn of_container(sheet: &mut Sheet, container: &ContainerRun) {
    sheet.field("Image", format!("{} (pulled {:?})", container.image, container.pull_policy));
    let line: Vec<String> = container.command.iter().chain(&container.args).cloned().collect();
    if !line.is_empty() {
        sheet.field("Command", command_line(&line));
    }
    sheet.field("Network", format!("{:?}", container.network));
    let mounts = container.mounts.iter().map(|m| {
        let how = if m.read_only { " (read only)" } else { "" };
        format!("{} → {}{how}", m.host_path, m.mount_path)
    });
    sheet.list("Mounts", mounts);
    environment(sheet, &container.env, &container.env_from);
    files(sheet, &container.files);
    sheet.maybe("Directory", container.working_dir.clone());
}

fn of_process(sheet: &mut Sheet, process: &ProcessRun) {
    let line: Vec<String> = process.command.iter().chain(&process.args).cloned().collect();
    sheet.field("Process", command_line(&line));
    sheet.maybe("User", process.user.clone());
    let alone = process.network == ProcessNetwork::None;
    sheet.maybe("Network", alone.then(|| "None".to_owned()));
    environment(sheet, &process.env, &process.env_from);
    files(sheet, &process.files);
    sheet.maybe("Directory", process.working_dir.clone());
}

fn environment(sheet: &mut Sheet, all: &[EnvVar], from: &[EnvFrom]) {
    let variable = |v: &EnvVar| {
        let from = v.value_from.as_ref();
        let map = from.and_then(|f| f.config_map_key_ref.as_ref()).map(|r| ("configmap", r));
        let secret = from.and_then(|f| f.secret_key_ref.as_ref()).map(|r| ("secret", r));
        match map.or(secret) {
            None => format!("{}={}", v.name, v.value),
            Some((kind, of)) => {
                format!(
                    "{} from {kind}/{}, key {}{}",
                    v.name,
                    of.name,
                    of.key,
                    optional(of.optional)
                )
            }
        }
    };
    let whole = |f: &EnvFrom| {
        let map = f.config_map_ref.as_ref().map(|r| ("configmap", r));
        let (kind, of) = map.or_else(|| f.secret_ref.as_ref().map(|r| ("secret", r)))?;
        Some(format!("{}* from {kind}/{}{}", f.prefix, of.name, optional(of.optional)))
    };
    sheet.list("Environment", from.iter().filter_map(whole).chain(all.iter().map(variable)));
}

fn files(sheet: &mut Sheet, all: &[Files]) {
    let line = |f: &Files| {
        let map = f.config_map.as_ref().map(|name| ("configmap", name));
        let (kind, name) = map.or_else(|| f.secret.as_ref().map(|name| ("secret", name)))?;
        Some(format!("{} from {kind}/{name}{}", f.mount_path, optional(f.optional)))
    };
    sheet.list("Files", all.iter().filter_map(line));
}

fn optional(optional: bool) -> &'static str {
    if optional { " (optional)" } else { "" }
}

/// The words of a command; those that a shell would split are quoted, so that it is seen where each ends.
pub(super) fn command_line(words: &[String]) -> String {
    let plain = |w: &str| {
        !w.is_empty() && w.chars().all(|c| c.is_ascii_alphanumeric() || "-_./=:,@%+".contains(c))
    };
    let word = |w: &String| if plain(w) { w.clone() } else { format!("{w:?}") };
    words.iter().map(word).collect::<Vec<_>>().join(" ")
}
