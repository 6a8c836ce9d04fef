//! What happens. Each fault begins, lasts, ends; then the cluster settles.

use std::fmt;
use std::time::{Duration, Instant};

use clap::ValueEnum;
use muster_api::id::Epoch;
use muster_api::kind::lease::Lease;
use muster_tests::dice::Dice;
use muster_tests::wire::Way;
use muster_tests::{docker, kernel, wait};

use crate::house::{DEADLINE, House, processes};
use crate::report::Report;
use crate::{residents, witness};

/// A kind of fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub(crate) enum Fault {
    /// `kill -9`; the controller's, an agent's, all of them at once.
    KillController,
    KillAgent,
    KillAll,
    /// The process above a task; the task's program; the process before a robot's drivers.
    KillShim,
    KillProgram,
    KillGate,
    /// SIGSTOP, and SIGCONT after some seconds.
    FreezeController,
    FreezeAgent,
    /// Nothing passes between controller and agent: both ways, from the agent, to the agent.
    Cut,
    CutFromAgent,
    CutToAgent,
    /// A fifth of all packets is lost, the others are slow.
    BadRadio,
    /// Not a byte is left.
    FullController,
    FullAgent,
    /// The date jumps, and back.
    JumpController,
    JumpAgent,
    /// The controller goes on with a copy of its data.
    MoveController,
    /// Two nodes are away for long, one cut off, one frozen: what must stop without contact does, and runs elsewhere.
    LongAway,
}

impl Fault {
    pub(crate) const ALL: [Fault; 18] = [
        Fault::KillController,
        Fault::KillAgent,
        Fault::KillAll,
        Fault::KillShim,
        Fault::KillProgram,
        Fault::KillGate,
        Fault::FreezeController,
        Fault::FreezeAgent,
        Fault::Cut,
        Fault::CutFromAgent,
        Fault::CutToAgent,
        Fault::BadRadio,
        Fault::FullController,
        Fault::FullAgent,
        Fault::JumpController,
        Fault::JumpAgent,
        Fault::MoveController,
        Fault::LongAway,
    ];
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let value = self.to_possible_value().expect("none is skipped");
        f.pad(value.get_name())
    }
}

/// Begins it, ends it, and waits until the cluster has settled.
pub(crate) async fn happen(fault: Fault, house: &mut House, dice: &mut Dice, report: &mut Report) {
    report.began(fault);
    let node = house.machines[dice.below(house.machines.len())].name;
    report.say(&format!("{fault} ({node})"));
    match fault {
        Fault::KillController => {
            house.cluster.kill_controller();
            tokio::time::sleep(dice.millis(0, 1_000)).await;
            house.cluster.start_controller().await;
        }
        Fault::KillAgent => {
            house.cluster.kill_agent(node);
            tokio::time::sleep(dice.millis(0, 1_000)).await;
            house.cluster.spawn_agent(node, None);
        }
        Fault::KillAll => kill_all(house, dice).await,
        Fault::KillShim | Fault::KillProgram => hit(fault, house, node, report).await,
        Fault::KillGate => kill_gate(house, report).await,
        Fault::FreezeController => {
            let pid = house.cluster.controller_pid();
            kernel::freeze(pid, true);
            tokio::time::sleep(dice.millis(500, 1_500)).await;
            kernel::freeze(pid, false);
        }
        Fault::FreezeAgent => {
            let pid = house.cluster.agent_pid(node);
            kernel::freeze(pid, true);
            lost(fault, house, node, Instant::now(), report).await;
            kernel::freeze(pid, false);
        }
        Fault::Cut | Fault::CutFromAgent | Fault::CutToAgent => {
            cut(fault, house, node, report).await
        }
        Fault::BadRadio => {
            let delay = Duration::from_millis(30);
            let way = Way { loss: 0.2, delay, rate: Some(5e6), ..Way::CLEAR };
            house.machine(node).wire.shape(way, way);
            tokio::time::sleep(Duration::from_secs(2)).await;
            house.machine(node).wire.shape(Way::CLEAR, Way::CLEAR);
        }
        Fault::FullController => {
            house.disk.fill();
            tokio::time::sleep(Duration::from_secs(1)).await;
            house.disk.empty();
        }
        Fault::FullAgent => {
            let machine = house.machines.iter().find(|m| m.disk.is_some());
            let disk = machine.and_then(|m| m.disk.as_ref()).expect("robot-2 has one");
            disk.fill();
            tokio::time::sleep(Duration::from_secs(1)).await;
            disk.empty();
        }
        Fault::JumpController | Fault::JumpAgent => {
            let clock = match fault {
                Fault::JumpController => &house.clock,
                _ => &house.machine(node).clock,
            };
            let seconds = *[-7_200, -90, 90, 7_200].get(dice.below(4)).expect("of four");
            clock.set(seconds);
            tokio::time::sleep(Duration::from_millis(1_500)).await;
            clock.set(0);
        }
        Fault::MoveController => {
            house.cluster.kill_controller();
            house.move_controller();
            house.cluster.start_controller().await;
        }
        Fault::LongAway => long_away(house, dice, report).await,
    }
    house.settle(report, Some(fault)).await;
}

async fn kill_all(house: &mut House, dice: &mut Dice) {
    let names: Vec<_> = house.machines.iter().map(|machine| machine.name).collect();
    house.cluster.kill_controller();
    for name in &names {
        house.cluster.kill_agent(name);
    }
    tokio::time::sleep(dice.millis(0, 500)).await;
    for name in &names {
        house.cluster.spawn_agent(name, None);
    }
    house.cluster.start_controller().await;
}

/// Kills the program of a task, or the process above it: it is started anew, once.
async fn hit(fault: Fault, house: &House, node: &str, report: &mut Report) {
    let Some(uid) = residents::victim(house, node).await else {
        report.broken("no task that could be hit comes to run".to_owned());
        return;
    };
    let programs = kernel::with_env("MUSTER_UID", &uid);
    let victims = match fault {
        Fault::KillProgram => programs.iter().map(|program| program.pid).collect(),
        _ => processes(&["shim", &uid]),
    };
    if victims.len() == 1 {
        kernel::kill(victims[0]);
        let (begun, both) = (Instant::now(), [(uid.clone(), 1), (uid.clone(), 2)]);
        while !witness::starts(house, "victim").ends_with(&both) {
            if begun.elapsed() > DEADLINE {
                report.broken(format!("not started anew {DEADLINE:?} after {fault}"));
                break;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    } else {
        report.broken(format!("{} processes to kill, not one", victims.len()));
    }
    house.cluster.delete("victim").await;
}

/// Kills a robot's gate: the first thing that its driver hears of the next one is the stop.
async fn kill_gate(house: &House, report: &mut Report) {
    let robot = house.machine("robot-1");
    let heard = robot.heard.as_ref().expect("robots have drivers");
    let dir = house.cluster.dir().join("robot-1").display().to_string();
    let gates = || processes(&[&dir, "gate"]);
    let stops = || std::fs::read_to_string(heard).unwrap_or_default().lines().count();
    let (before, said) = (gates(), stops());
    if before.len() != 1 {
        report.broken(format!("robot-1 has {} gates", before.len()));
        return;
    }
    kernel::kill(before[0]);
    let killed = Instant::now();
    while stops() == said {
        if killed.elapsed() > DEADLINE {
            report.broken(format!("no stop at the driver {DEADLINE:?} after its gate was killed"));
            return;
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    report.measured(
        "gate killed: the driver reads a stop",
        killed.elapsed(),
        Duration::from_millis(250),
    );
}

async fn cut(fault: Fault, house: &House, node: &str, report: &mut Report) {
    let wire = &house.machine(node).wire;
    let (down, up) = match fault {
        Fault::CutFromAgent => (Way::CLEAR, Way::CUT),
        Fault::CutToAgent => (Way::CUT, Way::CLEAR),
        _ => (Way::CUT, Way::CUT),
    };
    wire.shape(down, up);
    lost(fault, house, node, Instant::now(), report).await;
    wire.shape(Way::CLEAR, Way::CLEAR);
}

/// Waits until a node counts as lost that is away since `begun`.
async fn lost(fault: Fault, house: &House, node: &str, begun: Instant, report: &mut Report) {
    while house.is_ready(node).await != Some(false) {
        if begun.elapsed() > DEADLINE {
            report.broken(format!("{node} counts as ready {DEADLINE:?} after {fault}"));
            return;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    report.detected(fault, begun.elapsed());
}

/// On top of the time after which a task without contact stops: then it surely has.
const STOP_MARGIN: Duration = Duration::from_secs(15);

/// How long before it was away a node may have been heard last: after that it would have counted as lost.
const LAST_HEARD: Duration = Duration::from_secs(2);

/// How a node is away.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Away {
    CutOff,
    Frozen,
    Dead,
}

impl Away {
    fn begin(self, house: &mut House, node: &str) {
        match self {
            Away::CutOff => house.machine(node).wire.shape(Way::CUT, Way::CUT),
            Away::Frozen => kernel::freeze(house.cluster.agent_pid(node), true),
            Away::Dead => house.cluster.kill_agent(node),
        }
    }

    fn end(self, house: &mut House, node: &str) {
        match self {
            Away::CutOff => house.machine(node).wire.shape(Way::CLEAR, Way::CLEAR),
            Away::Frozen => kernel::freeze(house.cluster.agent_pid(node), false),
            Away::Dead => house.cluster.spawn_agent(node, None),
        }
    }
}

/// A task of a resident set: its set, its uid, its node.
#[derive(Debug)]
struct Placed {
    set: &'static str,
    uid: String,
    node: String,
}

async fn placed(house: &House, set: &'static str) -> Option<Placed> {
    let task = residents::of_set(house, set).await.pop()?;
    Some(Placed { set, uid: task.metadata.uid?, node: task.status?.node? })
}

async fn long_away(house: &mut House, dice: &mut Dice, report: &mut Report) {
    let (Some(roam), Some(boxed)) = (placed(house, "roam").await, placed(house, "box").await)
    else {
        report.broken("a resident set has no task that runs".to_owned());
        return;
    };
    house.time_container();
    let mut ways = [Away::CutOff, Away::Frozen, Away::Dead];
    dice.shuffle(&mut ways);
    let mut nodes = vec![(roam.node.clone(), ways[0])];
    // With both robots away there would be none for who needs one.
    if boxed.node == "cloud-1" {
        nodes.push((boxed.node.clone(), ways[1]));
    }
    let mut tasks = vec![&roam];
    if nodes.iter().any(|(node, _)| *node == boxed.node) {
        tasks.push(&boxed);
    }
    report.say(&format!("  away: {nodes:?}"));
    let lease = lease_of(house, "robot-2").await;
    let begun = Instant::now();
    for (node, way) in &nodes {
        way.begin(house, node);
    }
    for (node, _) in &nodes {
        lost(Fault::LongAway, house, node, begun, report).await;
    }
    has_stopped(&tasks, begun, report).await;
    // Two hours by the date are no two hours.
    house.clock.set(7_200);
    tokio::time::sleep(Duration::from_millis(1_500)).await;
    house.clock.set(0);
    runs_elsewhere(house, &tasks, begun, report).await;
    let away = nodes.iter().any(|(node, _)| node == "robot-2");
    if away && lease_of(house, "robot-2").await != lease {
        report.broken("robot-2's lease was given on while robot-2 is away".to_owned());
    }
    for (node, way) in &nodes {
        way.end(house, node);
    }
    if tasks.len() == 2 {
        let left = async || {
            let containers = docker::containers_of(&boxed.uid);
            if containers.is_empty() { Ok(()) } else { Err(format!("{containers:?}")) }
        };
        wait::until("nothing is left of the container that was replaced", left).await;
    }
}

/// What must stop without contact has, in time, with nobody to tell it.
async fn has_stopped(tasks: &[&Placed], begun: Instant, report: &mut Report) {
    let stops = Duration::from_secs(residents::STOPS_AFTER);
    for Placed { set, uid, .. } in tasks {
        let gone = async || {
            let left = kernel::with_env("MUSTER_UID", uid).len();
            if left == 0 { Ok(()) } else { Err(format!("{left} processes")) }
        };
        wait::until(&format!("{set} has stopped without contact"), gone).await;
        let what = format!("{set} without contact: its processes are gone");
        report.measured(&what, begun.elapsed(), stops + Duration::from_millis(500));
    }
}

/// It runs elsewhere, as soon as the one before has surely stopped.
async fn runs_elsewhere(house: &House, tasks: &[&Placed], begun: Instant, report: &mut Report) {
    let stops = Duration::from_secs(residents::STOPS_AFTER);
    let floor = house.container.mul_f64(1.1) + Duration::from_millis(50);
    for Placed { set, uid, .. } in tasks {
        let elsewhere = async || match residents::of_set(house, set).await.pop() {
            Some(task) if task.metadata.uid.as_ref() != Some(uid) => Ok(()),
            other => Err(format!("{:?}", other.map(|task| task.metadata.name))),
        };
        wait::until(&format!("{set} runs elsewhere"), elsewhere).await;
        if begun.elapsed() + LAST_HEARD < stops + STOP_MARGIN {
            let early = begun.elapsed();
            report.broken(format!("{set} runs elsewhere after {early:.1?}, and may run still"));
        }
        let what = format!("{set} without contact: it runs elsewhere");
        report.measured(&what, begun.elapsed(), stops + STOP_MARGIN + floor);
    }
}

/// Who holds a robot, and since which epoch.
async fn lease_of(house: &House, robot: &str) -> Option<(String, Epoch)> {
    let leases: kube::Api<Lease> = kube::Api::all(house.client.clone());
    let lease = leases.get(&format!("{robot}.body")).await.ok()?.status?;
    Some((format!("{:?}", lease.holder), lease.epoch))
}
