//! How the gate stands, as the agent knows it, and what of that the controller is told.

use muster_api::condition::{ACTUATORS_FENCED, Condition, EMERGENCY_STOP};
use muster_api::id::TaskUid;
use muster_api::kind::node::estop::{EStopDemand, EStopStatus, EStopTier};
use muster_api::name::FunctionName;
use muster_api::wire::gate::v1 as proto;

use super::wanted::PERSON;

/// How the gate stands.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Standing {
    /// Nobody stands before the drivers while it is `None`.
    pub status: Option<proto::Status>,
}

impl Standing {
    /// Whether everything up to this number that was wanted counts.
    #[must_use]
    pub fn counts(&self, wanted: u64) -> bool {
        self.status.as_ref().is_some_and(|status| status.wanted >= wanted)
    }

    /// What the Node says of it. `actuators`: those of the robot.
    #[must_use]
    pub fn conditions(&self, actuators: &[FunctionName]) -> Vec<Condition> {
        let stopped = self.estop().map(|estop| emergency_stop(&estop));
        std::iter::once(self.fenced(actuators)).chain(stopped).collect()
    }

    /// Whether every actuator is behind the gate, and every driver is there.
    fn fenced(&self, actuators: &[FunctionName]) -> Condition {
        let no = |reason, message| Condition::new(ACTUATORS_FENCED, false, reason, message);
        let Some(status) = &self.status else {
            return no("GateDown", "the gate is being started; the robot stands".to_owned());
        };
        let missing = status.drivers.iter().find(|driver| !driver.error.is_empty());
        if let Some(driver) = missing {
            let moves = driver.actuators.join(", ");
            return no(
                "DriverDown",
                format!("the driver of {moves} is not there: {}", driver.error),
            );
        }
        let shared = status.drivers.iter().find_map(|driver| driver.doubt.as_ref());
        if let Some(doubt) = shared {
            return Condition::new(ACTUATORS_FENCED, false, &doubt.reason, doubt.why.clone());
        }
        let driven = |actuator: &&FunctionName| {
            status.drivers.iter().flat_map(|d| &d.actuators).all(|a| *a != actuator.to_string())
        };
        match actuators.iter().find(driven) {
            Some(actuator) => no(
                "NoDriver",
                format!("no driver of {actuator} is behind the gate; its commands are not checked"),
            ),
            None => Condition::new(ACTUATORS_FENCED, true, "Gate", String::new()),
        }
    }

    /// The task whose right to drive is given back.
    pub(crate) fn gives_back(&self) -> Option<TaskUid> {
        self.status.as_ref()?.gives_back.as_ref().map(|holder| TaskUid::new(holder.task.clone()))
    }

    /// The person's grant that counts, so that nobody else drives; 0: none.
    #[must_use]
    pub fn person_epoch(&self) -> u64 {
        let holder = self.status.as_ref().and_then(|status| status.holder.as_ref());
        holder.filter(|holder| holder.task == PERSON).map_or(0, |holder| holder.epoch)
    }

    /// What stops the robot.
    #[must_use]
    pub fn estop(&self) -> Option<EStopStatus> {
        let estop = self.status.as_ref()?.estop.as_ref()?;
        let demand = |demand: &proto::Demand| EStopDemand {
            source: demand.source.clone(),
            tier: EStopTier::from_number(demand.tier),
        };
        Some(EStopStatus {
            tier: EStopTier::from_number(estop.tier),
            number: estop.number,
            demands: estop.demands.iter().map(demand).collect(),
        })
    }
}

fn emergency_stop(estop: &EStopStatus) -> Condition {
    if estop.tier.is_none() {
        return Condition::new(EMERGENCY_STOP, false, "Released", String::new());
    }
    let demands: Vec<String> =
        estop.demands.iter().map(|d| format!("{} by {}", d.tier, d.source)).collect();
    let message =
        format!("{}; `muster estop NODE --release` lets it move again", demands.join(", "));
    Condition::new(EMERGENCY_STOP, true, &estop.tier.to_string(), message)
}
