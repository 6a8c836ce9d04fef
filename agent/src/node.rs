//! What this node is and has, as the controller is told.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use muster_api::condition::{
    ACTUATORS_FENCED, Condition, DISK_PRESSURE, LOCALIZED, POSE_FRESH, QUOTAS_ENFORCED,
};
use muster_api::kind::node::RuntimeStatus;
use muster_api::pose::Pose;
use muster_api::wire::agent::v1 as proto;
use muster_api::wire::agent_session::NodeReport;
use tokio::time::Instant;

use crate::capacity::{Capacity, Machine};
use crate::config::{Config, Kind};
use crate::driver::Shared;
use crate::gauge::battery::BatteryGauge;
use crate::gauge::disk::DiskGauge;
use crate::gauge::machine;
use crate::mission;
use crate::position::Position;
use crate::sim::keeper::Simulator;

/// Between two live poses. A robot at 1.5 m/s moves 15 cm in it, less than placement by distance can care for.
const POSE_EVERY: Duration = Duration::from_millis(100);

/// The node's face. Owned by the link: it alone tells the controller.
#[derive(Debug)]
pub(crate) struct Node {
    shared: Arc<Shared>,
    fixed: NodeReport,
    boot_id: String,
    position: Option<Position>,
    battery: Option<BatteryGauge>,
    disk: DiskGauge,
    data_dir: PathBuf,
    machine: Machine,
    told: Option<proto::NodeState>,
    told_pose: Option<Pose>,
    told_pose_at: Option<Instant>,
}

/// Facts found at the start.
#[derive(Debug)]
pub(crate) struct Facts {
    pub(crate) kind: Kind,
    pub(crate) capacity: Capacity,
    /// Or why quotas are not enforced.
    pub(crate) enforced: Result<Enforced, String>,
    pub(crate) address: String,
}

/// How quotas are enforced.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Enforced {
    pub(crate) version: u8,
}

impl Node {
    pub(crate) fn new(
        config: &Config,
        facts: Facts,
        shared: Arc<Shared>,
        simulator: Option<&Simulator>,
    ) -> Node {
        let fixed = NodeReport {
            kind: facts.kind.into(),
            labels: labels(config),
            capacity: facts.capacity.capacity,
            allocatable: facts.capacity.allocatable,
            sensors: config.sensors.iter().cloned().collect(),
            actuators: config.actuators.iter().cloned().collect(),
            pose: None,
            runtimes: Vec::new(),
            conditions: conditions(config, facts.enforced),
            speed: config.speed,
            address: facts.address,
            battery: None,
            mission_locks: Vec::new(),
            estop: None,
            images: Vec::new(),
        };
        let position = match facts.kind {
            Kind::Robot => config.position.as_ref().and_then(|source| {
                source.open(&config.map, shared.node.as_str(), &config.pose, simulator)
            }),
            Kind::Cloud => None,
        };
        let battery = match facts.kind {
            Kind::Robot => config.battery.as_ref().and_then(|source| source.open(simulator)),
            Kind::Cloud => None,
        };
        let disk = DiskGauge::open(&config.data_dir);
        let boot_id = shared.boot_id.clone();
        let machine = Machine::default();
        Node {
            shared,
            fixed,
            boot_id,
            position,
            battery,
            disk,
            data_dir: config.data_dir.clone(),
            machine,
            told: None,
            told_pose: None,
            told_pose_at: None,
        }
    }

    /// Everything, for a Hello.
    pub(crate) fn state(&mut self) -> proto::NodeState {
        let pose = self.position.as_ref().and_then(Position::current);
        self.told_pose.clone_from(&pose);
        self.told_pose_at = Some(Instant::now());
        let mut state = self.without_pose();
        self.told = Some(state.clone());
        state.pose = pose.as_ref().map(proto::Pose::from);
        state
    }

    fn without_pose(&self) -> proto::NodeState {
        let runtime = |name: &str, status: crate::runtime::RuntimeStatus| RuntimeStatus {
            name: name.to_owned(),
            available: status.available,
            version: status.version,
            message: status.message,
        };
        let runtimes = vec![
            runtime("process", self.shared.process.status()),
            runtime("docker", self.shared.docker.status()),
        ];
        let mut conditions = self.fixed.conditions.clone();
        conditions.push(match self.disk.pressure() {
            Some(why) => Condition::new(DISK_PRESSURE, true, "DiskNearlyFull", why),
            None => Condition::new(DISK_PRESSURE, false, "EnoughSpace", String::new()),
        });
        if let Some(position) = &self.position {
            let seen = position.seen();
            let verdicts = [(POSE_FRESH, seen.fresh), (LOCALIZED, Some(seen.localized))];
            for (condition, verdict) in verdicts {
                conditions.extend(
                    verdict.map(|v| Condition::new(condition, v.holds, v.reason, v.message)),
                );
            }
        }
        conditions.extend(self.shared.sensors.condition());
        let battery = self.battery.as_ref().and_then(BatteryGauge::charge);
        let mission_locks =
            mission::locks(&self.data_dir, &self.shared.checkpoint, self.shared.board.live());
        let mut estop = None;
        if let Some(gate) = &self.shared.gate {
            let standing = gate.standing();
            let standing = standing.borrow();
            conditions.extend(standing.conditions(&self.fixed.actuators));
            estop = standing.estop();
        }
        let report = NodeReport {
            runtimes,
            conditions,
            battery,
            mission_locks,
            estop,
            images: self.shared.images.states(),
            ..self.fixed.clone()
        };
        let mut state = proto::NodeState::from(&report);
        state.boot_id.clone_from(&self.boot_id);
        let gate = self.shared.gate.as_ref();
        state.person_epoch = gate.map_or(0, |gate| gate.standing().borrow().person_epoch());
        state
    }

    /// The state, when something about it has changed since it was last told.
    pub(crate) fn changed(&mut self) -> Option<proto::NodeState> {
        if self.told.as_ref() == Some(&self.without_pose()) { None } else { Some(self.state()) }
    }

    /// The pose, when it has changed since it was last told; at most once in [`POSE_EVERY`]. Cancel safe: it counts as
    /// told when it is given.
    pub(crate) async fn moved(&mut self) -> proto::Pose {
        loop {
            let Some(position) = &mut self.position else { return std::future::pending().await };
            position.other_than(self.told_pose.as_ref()).await;
            if let Some(at) = self.told_pose_at {
                tokio::time::sleep_until(at + POSE_EVERY).await;
            }
            (self.told_pose, self.told_pose_at) = (position.current(), Some(Instant::now()));
            if let Some(pose) = &self.told_pose {
                return pose.into();
            }
        }
    }

    /// The machine's usage since the last look.
    pub(crate) fn usage(&mut self) -> Option<proto::Usage> {
        let (cpu_millis, memory_bytes) = self.machine.sample()?;
        Some(proto::Usage { cpu_millis, memory_bytes, cpu_total_usec: 0 })
    }
}

fn labels(config: &Config) -> BTreeMap<String, String> {
    let mut labels = BTreeMap::from([
        ("muster.dev/arch".to_owned(), std::env::consts::ARCH.to_owned()),
        ("muster.dev/os".to_owned(), std::env::consts::OS.to_owned()),
    ]);
    labels.extend(machine::labels());
    labels.extend(config.labels.clone());
    labels
}

fn conditions(config: &Config, enforced: Result<Enforced, String>) -> Vec<Condition> {
    let mut conditions = match enforced {
        Ok(Enforced { version: 1 }) => vec![
            Condition::new(QUOTAS_ENFORCED, true, "CgroupV1", String::new()),
            Condition::new(
                "BufferedWritesThrottled",
                false,
                "CgroupV1",
                "cgroup v1 throttles direct and read I/O; buffered writes are not held".to_owned(),
            ),
        ],
        Ok(Enforced { .. }) => {
            vec![Condition::new(QUOTAS_ENFORCED, true, "CgroupV2", String::new())]
        }
        Err(why) => {
            let then = if config.unenforced_quotas {
                "tasks with quotas run unlimited (--unenforced-quotas)"
            } else {
                "tasks with quotas are refused"
            };
            vec![Condition::new(QUOTAS_ENFORCED, false, "NoCgroups", format!("{why}; {then}"))]
        }
    };
    if !config.actuators.is_empty() && config.gate.is_empty() {
        conditions.push(Condition::new(
            ACTUATORS_FENCED,
            false,
            "NoGate",
            "no gate stands before this robot's drivers: leases are kept, commands are not checked; \
             name the drivers under `gate` in agent.yaml"
                .to_owned(),
        ));
    }
    conditions
}
