//! A task's spec, as the parts that decisions and runtimes need.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use muster_agent_core::desired::{Desired, RestartPolicy, StopOrder};
use muster_agent_core::workload::Fetch;
use muster_api::duration::Span;
use muster_api::kind::task::{self, TaskSpec};
use muster_api::wire::WireError;
use muster_api::wire::agent_session::spec_from_wire;

use crate::checkpoint::Assignment;
use crate::executor;
use crate::gate;
use crate::probe;
use crate::ros::Ros;
use crate::runtime::launch::{
    AttemptId, Container, Launch, Lease, Limits, Mount, Network, Program, Pull, Work,
};
use crate::sensor;

/// Processes and threads of a task that names no limit: enough for a large ROS graph, and far from
/// what a fork bomb needs to take a robot down.
const DEFAULT_PIDS: u64 = 4_096;

/// The least memory cap that the agent puts on a task which reserved none: below it nothing starts.
const MIN_MEMORY_CAP: u64 = 16 << 20;

/// Which runtime runs a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Process,
    Docker,
    Work,
}

impl Kind {
    pub(crate) fn of(spec: &TaskSpec) -> Kind {
        match (&spec.run.container, &spec.run.executor) {
            (Some(_), _) => Kind::Docker,
            (None, Some(_)) => Kind::Work,
            (None, None) => Kind::Process,
        }
    }
}

/// What its runtime may have to fetch for it.
pub(crate) fn fetch(spec: &TaskSpec) -> Fetch {
    match &spec.run.container {
        None if spec.run.executor.is_some() => Fetch::Executor,
        None => Fetch::Nothing,
        Some(run) if run.pull_policy == task::PullPolicy::Always => Fetch::Always,
        Some(_) => Fetch::Missing,
    }
}

/// A spec as an assignment carries it. One that names no runtime of this agent cannot be read.
pub(crate) fn read(bytes: &[u8]) -> Result<TaskSpec, WireError> {
    let spec = spec_from_wire(bytes)?;
    let run = &spec.run;
    if run.process.is_none() && run.container.is_none() && run.executor.is_none() {
        let none = "run: this agent runs process, container and executor, and none is there";
        return Err(WireError::invalid("assignment.spec", none));
    }
    Ok(spec)
}

/// What stands for a spec that cannot be read: it asks for nothing, and is never launched.
pub(crate) fn nothing() -> TaskSpec {
    spec_from_wire(b"{}").expect("every field of a spec has a default")
}

/// What the core needs to know.
pub(crate) fn desired(spec: &TaskSpec, stop: Option<StopOrder>) -> Desired {
    Desired {
        restart: match spec.restart_policy {
            task::RestartPolicy::Never => RestartPolicy::Never,
            task::RestartPolicy::OnFailure => RestartPolicy::OnFailure,
            task::RestartPolicy::Always => RestartPolicy::Always,
        },
        grace_ms: u64::from(spec.grace_period_seconds) * 1_000,
        stop_after_ms: spec.stop_after_disconnect().map(millis),
        standby_ms: spec.standby.map(|standby| millis(standby.after)),
        probes: probe::probes(spec),
        depends: Vec::new(),
        attempts: None,
        stop,
    }
}

fn millis(span: Span) -> u64 {
    u64::try_from(span.as_duration().as_millis()).unwrap_or(u64::MAX)
}

/// What the node adds to a launch.
#[derive(Debug, Clone)]
pub(crate) struct Surroundings<'a> {
    pub(crate) node: &'a str,
    /// The task's own directory.
    pub(crate) task_dir: &'a Path,
    /// What the task shows at its executor socket.
    pub(crate) token: &'a str,
    /// Where the gate's socket for tasks is, if there is a gate.
    pub(crate) gate: Option<&'a Path>,
    /// Some sensor that the task asks for has a source.
    pub(crate) sensors: bool,
    /// Where the node's ROS is.
    pub(crate) ros: &'a Ros,
    /// Memory that nobody reserved, bytes.
    pub(crate) unreserved: u64,
}

/// What a runtime needs to know.
pub(crate) fn launch(id: AttemptId, assignment: &Assignment, around: &Surroundings<'_>) -> Launch {
    let spec = &assignment.spec;
    let (program, variables) = program(assignment);
    let resources = &spec.resources;
    let mut env = environment(&id, assignment, around);
    env.extend(variables);
    Launch {
        program,
        env,
        given: assignment.given.clone(),
        limits: limits(spec, around.unreserved),
        promised: resources.cpu.is_some()
            || resources.memory.is_some()
            || resources.pids.is_some()
            || resources.io.is_some(),
        stop_signal: spec.stop_signal,
        grace_ms: u64::from(spec.grace_period_seconds) * 1_000,
        stop_after_ms: desired(spec, None).stop_after_ms,
        id,
    }
}

impl From<task::PullPolicy> for Pull {
    fn from(policy: task::PullPolicy) -> Self {
        match policy {
            task::PullPolicy::Always => Pull::Always,
            task::PullPolicy::IfNotPresent => Pull::IfNotPresent,
            task::PullPolicy::Never => Pull::Never,
        }
    }
}

/// What holds it. A work's are only what it names: they are added to its executor's.
pub(crate) fn limits(spec: &TaskSpec, unreserved: u64) -> Limits {
    let resources = &spec.resources;
    let io = resources.io.clone().unwrap_or_default();
    let named = Limits {
        cpu_millis: resources.cpu.map(|cpu| cpu.0),
        memory_bytes: resources.memory.map(|memory| memory.0),
        pids: resources.pids,
        read_bps: io.read_bps.map(|bps| bps.0),
        write_bps: io.write_bps.map(|bps| bps.0),
    };
    if Kind::of(spec) == Kind::Work {
        return named;
    }
    Limits {
        memory_bytes: named.memory_bytes.or_else(|| Some(unreserved.max(MIN_MEMORY_CAP))),
        pids: named.pids.or(Some(DEFAULT_PIDS)),
        ..named
    }
}

fn environment(
    id: &AttemptId,
    assignment: &Assignment,
    around: &Surroundings<'_>,
) -> BTreeMap<String, String> {
    let mut env = BTreeMap::from([
        ("MUSTER_TASK".to_owned(), assignment.name.clone()),
        ("MUSTER_NAMESPACE".to_owned(), assignment.namespace.clone()),
        ("MUSTER_UID".to_owned(), id.uid.to_string()),
        ("MUSTER_NODE".to_owned(), around.node.to_owned()),
        ("MUSTER_ATTEMPT".to_owned(), id.attempt.to_string()),
        ("MUSTER_RUN_DIR".to_owned(), around.task_dir.join("run").display().to_string()),
    ]);
    let socket = around.task_dir.join(executor::DIR).join(executor::SOCKET);
    env.insert(executor::SOCKET_ENV.to_owned(), socket.display().to_string());
    env.insert(executor::TOKEN_ENV.to_owned(), around.token.to_owned());
    if let Some(lease) = &assignment.lease {
        env.insert("MUSTER_LEASE".to_owned(), lease.clone());
    }
    if let Some(dir) = around.gate {
        env.insert(gate::SOCKET_ENV.to_owned(), dir.join(gate::SOCKET).display().to_string());
        env.insert(gate::TOKEN_ENV.to_owned(), around.token.to_owned());
    }
    if around.sensors {
        let dir = around.task_dir.join(sensor::DIR).display().to_string();
        env.insert(sensor::DIR_ENV.to_owned(), dir);
        env.insert(sensor::TOKEN_ENV.to_owned(), around.token.to_owned());
    }
    if let Some(ros) = &assignment.spec.ros {
        env.extend(around.ros.variables(ros, in_our_network(&assignment.spec.run)));
    }
    env
}

fn in_our_network(run: &task::Run) -> bool {
    let container = run.container.as_ref().is_none_or(|run| run.network == task::Network::Host);
    let process = run.process.as_ref();
    container && process.is_none_or(|run| run.network == task::ProcessNetwork::Host)
}

/// Whether the task has a ROS master of its own, and so a network.
pub(crate) fn has_view(spec: &TaskSpec) -> bool {
    spec.ros.as_ref().is_some_and(task::RosSpec::is_view)
}

fn variables(list: &[task::EnvVar]) -> BTreeMap<String, String> {
    let plain = list.iter().filter(|variable| variable.value_from.is_none());
    plain.map(|variable| (variable.name.clone(), variable.value.clone())).collect()
}

fn program(assignment: &Assignment) -> (Program, BTreeMap<String, String>) {
    let spec = &assignment.spec;
    if let (None, Some(run)) = (&spec.run.container, &spec.run.executor) {
        let work = Work {
            namespace: assignment.namespace.clone(),
            name: assignment.name.clone(),
            executor: run.task.clone(),
            framework: assignment.framework.as_ref().map(|framework| framework.id.clone()),
            data: run.data.clone(),
            lease: assignment.lease.as_deref().and_then(Lease::from_text),
        };
        return (Program::Work(work), BTreeMap::new());
    }
    if let Some(run) = &spec.run.container {
        let program = Program::Container(Container {
            image: run.image.clone(),
            command: run.command.clone(),
            args: run.args.clone(),
            working_dir: run.working_dir.clone(),
            mounts: run
                .mounts
                .iter()
                .map(|mount| Mount {
                    host: mount.host_path.clone(),
                    container: mount.mount_path.clone(),
                    read_only: mount.read_only,
                })
                .collect(),
            network: match run.network {
                task::Network::Host if !has_view(spec) => Network::Host,
                task::Network::Host | task::Network::None => Network::None,
                task::Network::Bridge => Network::Bridge,
            },
            run_as: run.user.clone(),
            user: None,
            pull: run.pull_policy.into(),
        });
        return (program, variables(&run.env));
    }
    // Admission lets neither through; an empty command fails as a start error that says so.
    let Some(run) = &spec.run.process else {
        let none = Program::Process {
            argv: Vec::new(),
            working_dir: None,
            user: None,
            network: Network::Host,
        };
        return (none, BTreeMap::new());
    };
    let argv = run.command.iter().chain(&run.args).cloned().collect();
    let working_dir = run.working_dir.as_ref().map(PathBuf::from);
    let network = match run.network {
        task::ProcessNetwork::Host if !has_view(spec) => Network::Host,
        task::ProcessNetwork::Host | task::ProcessNetwork::None => Network::None,
    };
    let program = Program::Process { argv, working_dir, user: run.user.clone(), network };
    (program, variables(&run.env))
}
