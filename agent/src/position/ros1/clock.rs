//! ROS's time: this machine's, or that of `/clock` while the parameter `/use_sim_time` is true.

use std::time::Duration;

use muster_agent_core::pose::tracker::Clocks;
use muster_ros1::Node;
use muster_ros1::node::{NodeError, SubscribeOptions, Subscriber};
use muster_ros1::rosgraph_msgs::Clock;
use muster_ros1::time::Time;
use muster_ros1::xmlrpc::Value;
use tokio::sync::watch;

use crate::clock;

/// Without a node, this machine's.
#[derive(Debug, Default)]
pub(super) struct RosClock {
    /// `/use_sim_time`.
    wanted: Option<watch::Receiver<Option<Value>>>,
    simulated: Option<Simulated>,
}

#[derive(Debug)]
struct Simulated {
    topic: Subscriber<Clock>,
    newest: Option<Time>,
}

impl RosClock {
    pub(super) fn open(node: &Node) -> Result<Self, NodeError> {
        Ok(RosClock { wanted: Some(node.follow_param("/use_sim_time")?), simulated: None })
    }

    /// Ready when something about the clock has changed. Cancel safe: what came is kept.
    pub(super) async fn follow(&mut self, node: &Node) {
        let Some(wanted) = &mut self.wanted else { return std::future::pending().await };
        let tick = async {
            match &mut self.simulated {
                Some(simulated) => match simulated.topic.next().await {
                    Ok((tick, _)) => simulated.newest = Some(tick.clock),
                    Err(error) => tracing::debug!(%error, "a tick of /clock was not read"),
                },
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = tick => {}
            Ok(()) = wanted.changed() => {
                let simulated = matches!(&*wanted.borrow_and_update(), Some(Value::Bool(true) | Value::Int(1)));
                if simulated != self.simulated.is_some() {
                    let options = SubscribeOptions { queue: 1, ..SubscribeOptions::default() };
                    let topic = simulated.then(|| node.subscribe::<Clock>("/clock", options)).and_then(Result::ok);
                    self.simulated = topic.map(|topic| Simulated { topic, newest: None });
                }
            }
        }
    }

    /// What time it is.
    pub(super) fn clocks(&self) -> Clocks {
        let wall = Time::now().nanos();
        let ros = match &self.simulated {
            Some(simulated) => simulated.newest.map(Time::nanos),
            None => Some(wall),
        };
        Clocks { monotonic: Duration::from_millis(clock::boot().0), ros, wall }
    }
}
