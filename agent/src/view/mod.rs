//! ROS 1 for one task alone (`ros: {master: View}`): a master in the task's own network, which nobody else reaches, and in its graph
//! what the task may have of the robot's.
//!
//! ```text
//!        the task's network                                 │ the node's
//!  its nodes ⇄ master (127.0.0.1:11311)                     │
//!  its nodes ◀── sensors' topics ──── the node /muster ◀────┼── sensors that it asked for
//!  its nodes ─── actuators' topics ──▶    "       "    ─────┼─▶ gate, with the task's token and lease ──▶ drivers
//! ```
//!
//! | module | holds |
//! |---|---|
//! | `inside` | the thread that is in the task's network, its master, and the node /muster |
//! | `relay` | one topic of a sensor or an actuator |
//!
//! It is served while processes of the attempt may exist and the agent runs. What the master knows is in a file before it is answered,
//! so that the agent's next life goes on with it: nodes need not register again. The gate stops a robot whose relay is gone.

mod inside;
mod relay;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio_util::task::AbortOnDropHandle;

use crate::checkpoint::Record;
use crate::driver::{Shared, chain};
use crate::gate;
use crate::runtime::launch::Lease;
use crate::runtime::{Launch, Reached, Runtime};
use crate::sensor::reading::Topic as Sensor;

/// What the master knows, in the task's directory.
const FILE: &str = "ros-view";

/// Between two tries.
const AGAIN: Duration = Duration::from_secs(1);

/// What a task has in its view.
#[derive(Debug)]
pub(crate) struct Plan {
    attempt: u32,
    /// Where what its master knows is kept.
    file: PathBuf,
    sensors: Vec<Sensor>,
    actuators: Vec<Actuator>,
    /// None: it has no lease, or there is no gate.
    right: Option<Right>,
}

/// A topic, and what its messages command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Actuator {
    pub(crate) topic: String,
    pub(crate) actuator: String,
}

/// With what the gate is asked.
#[derive(Debug, Clone)]
struct Right {
    socket: PathBuf,
    token: String,
    epoch: u64,
}

impl Plan {
    /// Of a task as it is now.
    pub(crate) fn of(shared: &Shared, record: &Record) -> Plan {
        let Record { workload, assignment, token, .. } = record;
        let lease = assignment.lease.as_deref().and_then(Lease::from_text);
        let right = shared.gate.as_ref().zip(lease).map(|(gate, lease)| Right {
            socket: gate.tasks_dir().join(gate::SOCKET),
            token: token.clone(),
            epoch: lease.epoch,
        });
        let namespace = shared.topics.ros().namespace.as_deref();
        Plan {
            file: shared.checkpoint.task_dir(&workload.uid).join(FILE),
            attempt: workload.attempt,
            sensors: shared.sensors.topics(&assignment.spec.resources.sensors, namespace),
            actuators: shared.gate.as_ref().map(|gate| gate.topics()).unwrap_or_default(),
            right,
        }
    }
}

/// A task's view. Dropped: nobody serves it any more.
#[derive(Debug)]
pub(crate) struct View {
    /// Whose it is.
    pub(crate) attempt: u32,
    _keeps: AbortOnDropHandle<()>,
}

impl View {
    /// Of an attempt that runs.
    pub(crate) fn open(runtime: Arc<dyn Runtime>, launch: Launch, plan: Plan) -> View {
        let attempt = launch.id.attempt;
        let keeps = keep(runtime, launch, Arc::new(plan));
        View { attempt, _keeps: AbortOnDropHandle::new(tokio::spawn(keeps)) }
    }
}

async fn keep(runtime: Arc<dyn Runtime>, launch: Launch, plan: Arc<Plan>) {
    let mut told = String::new();
    loop {
        let why = match runtime.network(&launch).await {
            Ok(Reached::Inside(network)) => inside::serve(network, Arc::clone(&plan)).await,
            Ok(Reached::Here) => "it has no network of its own".to_owned(),
            Err(error) => chain(&error),
        };
        if why != told {
            tracing::warn!(id = %launch.id, why, "a task has no view of ROS for now");
            told = why;
        }
        tokio::time::sleep(AGAIN).await;
    }
}
