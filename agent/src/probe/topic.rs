//! Probes of topics: one ROS node for each master that is asked, and in it one subscription for each topic, however many
//! probes look at it. Each probe counts over a window of its own, from its first check on.
//!
//! ```text
//! Check ──look──▶ Topics ── node of the master ──▶ Arrivals (counted as they pass, nothing is kept) ──▶ core: judge
//! ```
//!
//! A node that no probe needs any more is taken out of its graph by [`Topics::run`], which the app owns.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt;
use muster_agent_core::probe::topic::{Seen, Wanted, judge};
use muster_agent_core::probe::{Answer, Role};
use muster_api::kind::task::probe::TopicCheck;
use muster_ros1::env::Environment;
use muster_ros1::name::{Resolver, plain};
use muster_ros1::node::{Arrivals, MasterState};
use muster_ros1::{Node, NodeOptions};
use tokio::sync::Mutex;
use tokio::time::MissedTickBehavior;

use crate::driver::chain;
use crate::ros::Ros;
use crate::runtime::Launch;

/// Between two looks at a topic that has not been watched for a whole window.
const LOOK: Duration = Duration::from_millis(50);

/// A node that has not been needed from one of these to the next goes. A task that is started again needs it at once.
const SWEEP: Duration = Duration::from_secs(30);

/// Nodes of graphs, by master.
#[derive(Debug, Default)]
pub(crate) struct Topics {
    ros: Ros,
    /// The name of the agent's node in ROS.
    name: String,
    nodes: Mutex<BTreeMap<String, Arc<Node>>>,
}

/// A probe's topic: where it is, and what is asked for.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Target {
    master: String,
    wanted: Wanted,
}

/// A topic that is being counted for a probe.
#[derive(Debug)]
pub(super) struct Counting {
    arrivals: Arrivals,
    /// The subscription is the node's.
    node: Arc<Node>,
}

impl Target {
    /// The topic of a check as its task means it: by the task's own environment, before what the agent knows.
    pub(super) fn of(check: &TopicCheck, launch: &Launch, ros: &Ros) -> Result<Target, String> {
        let given = launch.given.as_ref().map(|given| &given.variables[..]).unwrap_or_default();
        let variable = |name: &str| {
            let given = || given.iter().rev().find(|v| v.name == name).map(|v| v.value.clone());
            launch.env.get(name).cloned().or_else(given)
        };
        let environment = Environment::from_variables(variable);
        let master = check.master.clone().or(environment.master).or_else(|| ros.master.clone());
        let master = master.ok_or(
            "no ROS master is known: name it in the probe (topic.master), in ROS_MASTER_URI of the task's env, \
             or start the agent with --ros-master",
        )?;
        let namespace = environment.namespace.or_else(|| ros.namespace.clone());
        let topic = Resolver::new(namespace.as_deref().unwrap_or("/"), "probes", [])
            .and_then(|names| names.resolve(&check.name))
            .map_err(|error| error.to_string())?;
        let within = u64::try_from(check.within.as_duration().as_millis()).unwrap_or(u64::MAX);
        Ok(Target { master, wanted: Wanted { topic, min_hz: check.min_hz, within_ms: within } })
    }
}

impl Topics {
    pub(crate) fn new(ros: Ros, node: &str) -> Topics {
        let name = format!("muster_probes_{}", plain(node));
        Topics { ros, name, nodes: Mutex::default() }
    }

    pub(crate) fn ros(&self) -> &Ros {
        &self.ros
    }

    /// Begins to count a topic.
    async fn count(&self, target: &Target) -> Result<Counting, String> {
        let node = self.node(&target.master).await?;
        let window = Duration::from_millis(target.wanted.within_ms);
        let arrivals = node.count(&target.wanted.topic, window).map_err(|e| chain(&e))?;
        Ok(Counting { arrivals, node })
    }

    async fn node(&self, master: &str) -> Result<Arc<Node>, String> {
        let mut nodes = self.nodes.lock().await;
        if let Some(node) = nodes.get(master).filter(|node| node.ended().now_or_never().is_none()) {
            return Ok(Arc::clone(node));
        }
        let options = NodeOptions {
            name: self.name.clone(),
            master: Some(master.to_owned()),
            host: self.ros.host.clone(),
            // Names are global already.
            namespace: Some("/".to_owned()),
            ..NodeOptions::default()
        };
        let node = Arc::new(Node::start(options).await.map_err(|error| chain(&error))?);
        nodes.insert(master.to_owned(), Arc::clone(&node));
        Ok(node)
    }

    /// Ends nodes that no probe needs, until it is dropped.
    pub(crate) async fn run(&self) {
        let mut sweeps = tokio::time::interval(SWEEP);
        sweeps.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut idle: BTreeSet<String> = BTreeSet::new();
        loop {
            sweeps.tick().await;
            let mut nodes = self.nodes.lock().await;
            let unused = |node: &Arc<Node>| Arc::strong_count(node) == 1;
            let now: BTreeSet<String> =
                nodes.iter().filter(|(_, node)| unused(node)).map(|(m, _)| m.clone()).collect();
            for master in now.intersection(&idle) {
                if let Some(node) = nodes.remove(master).and_then(Arc::into_inner) {
                    node.shut_down().await;
                }
            }
            idle = now;
        }
    }
}

/// Makes a check. The first one of a probe, and the first after its node was ended by somebody, takes as long as the window
/// when too little comes. What is being counted is kept in `counting`.
pub(super) async fn answer(
    topics: &Topics,
    target: &Result<Target, String>,
    counting: &Mutex<Option<Counting>>,
    role: Role,
) -> Answer {
    let target = match target {
        Ok(target) => target,
        Err(why) => return Answer::Unknown(why.clone()),
    };
    let mut counting = counting.lock().await;
    loop {
        counting.take_if(|counting| counting.node.ended().now_or_never().is_some());
        let seen = match &*counting {
            Some(counting) => look(counting),
            None => match topics.count(target).await {
                Ok(begun) => look(counting.insert(begun)),
                Err(why) => return Answer::Unknown(why),
            },
        };
        if let Some(answer) = judge(&target.wanted, &seen, role) {
            return answer;
        }
        tokio::time::sleep(LOOK).await;
    }
}

fn look(counting: &Counting) -> Seen {
    let (arrivals, status) = (&counting.arrivals, counting.arrivals.status());
    Seen {
        count: arrivals.in_window(),
        whole: arrivals.hertz().is_some(),
        connected: status.connected,
        trouble: status.trouble,
        no_master: match &*counting.node.state().borrow() {
            MasterState::Gone { why } => Some(why.clone()),
            MasterState::Unknown | MasterState::Registered => None,
        },
    }
}

#[cfg(test)]
mod tests {
    use muster_api::kind::task::StopSignal;
    use std::sync::Arc;

    use muster_api::id::TaskUid;
    use muster_api::wire::agent::v1 as proto;
    use serde_json::json;

    use super::*;
    use crate::runtime::launch::{AttemptId, Limits, Network, Program};

    fn launch(env: &[(&str, &str)], given: &[(&str, &str)]) -> Launch {
        let pair = |(name, value): &(&str, &str)| ((*name).to_owned(), (*value).to_owned());
        let variable = |both: &(&str, &str)| {
            let (name, value) = pair(both);
            proto::Variable { name, value }
        };
        let variables = given.iter().map(variable).collect();
        Launch {
            id: AttemptId { uid: TaskUid::new("t"), attempt: 1 },
            program: Program::Process {
                argv: Vec::new(),
                working_dir: None,
                user: None,
                network: Network::Host,
            },
            env: env.iter().map(pair).collect(),
            given: Some(Arc::new(proto::Config { variables, files: Vec::new(), unresolved: None })),
            limits: Limits::default(),
            promised: false,
            stop_signal: StopSignal::default(),
            grace_ms: 0,
            stop_after_ms: None,
        }
    }

    fn check(name: &str, master: Option<&str>) -> TopicCheck {
        serde_json::from_value(json!({"name": name, "minHz": 5.0, "master": master})).unwrap()
    }

    #[test]
    fn the_probe_goes_before_the_task_and_the_task_before_the_agent() {
        let ros = Ros {
            master: Some("http://agent:1".to_owned()),
            namespace: Some("/robot".to_owned()),
            host: None,
        };
        let target = |check: &TopicCheck, launch: &Launch| {
            let target = Target::of(check, launch, &ros).unwrap();
            (target.master, target.wanted.topic)
        };
        let both = |master: &str, topic: &str| (master.to_owned(), topic.to_owned());
        let plain = launch(&[], &[]);
        assert_eq!(target(&check("scan", None), &plain), both("http://agent:1", "/robot/scan"));
        let task = launch(
            &[("ROS_MASTER_URI", "http://task:1"), ("ROS_NAMESPACE", "/r7")],
            &[("ROS_MASTER_URI", "http://map:1")],
        );
        assert_eq!(target(&check("scan", None), &task), both("http://task:1", "/r7/scan"));
        let given = launch(&[], &[("ROS_MASTER_URI", "http://map:1")]);
        assert_eq!(target(&check("/scan", None), &given), both("http://map:1", "/scan"));
        let probe = check("/scan", Some("http://probe:1"));
        assert_eq!(target(&probe, &task), both("http://probe:1", "/scan"));
    }

    #[tokio::test]
    async fn without_a_master_it_says_where_to_name_one() {
        let topics = Topics::default();
        let target = Target::of(&check("/scan", None), &launch(&[], &[]), topics.ros());
        let answer = answer(&topics, &target, &Mutex::default(), Role::Readiness).await;
        let Answer::Unknown(why) = answer else { panic!("{answer:?}") };
        assert!(why.contains("topic.master") && why.contains("--ros-master"), "{why}");
    }
}
