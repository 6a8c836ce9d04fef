//! What of a Task and a Node matters to an application.

use std::time::Duration;

use muster_api::kind::node::{Node, Taint};
use muster_api::kind::task::Task;
use muster_api::selector::LabelSelector;

use crate::cluster::NodeFacts;
use crate::owner::Owner;
use crate::taskset::view::{Claim, NodeView, TaskView};

/// A task of the application.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskSeen {
    /// Its uid.
    pub uid: String,
    /// Its life.
    pub view: TaskView,
    /// Cores and bytes that it reserves where it is placed.
    pub reserves: (f64, f64),
    /// It stands by, and its node begins it after so long without contact.
    pub standby: Option<Duration>,
    /// Mean use of cpu since its attempt began, cores; none: it has not run for long enough to say.
    pub used: Option<f64>,
    /// What its program tells, by topic or signal: messages a second, or the signal's value.
    pub tells: Vec<(String, f64)>,
}

/// A node.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeSeen {
    /// What it is, and whether it is heard.
    pub view: NodeView,
    /// Taints that its conditions put on it for now.
    pub passing: Vec<Taint>,
    /// Cores and bytes that nobody has reserved.
    pub free: (f64, f64),
    /// Cores and bytes that tasks may reserve.
    pub allocatable: (f64, f64),
    /// What its link is known to do.
    pub link: LinkSeen,
    /// No controller has heard it since one was started: nobody knows for how long it has been silent.
    pub unheard: bool,
}

/// What is known of the link between a node and the network.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LinkSeen {
    /// From the node to the controller and back; none: not measured yet.
    pub round_trip: Option<Duration>,
    /// What it carries, bits a second; none: nobody knows, and nothing is held to it.
    pub bandwidth: Option<f64>,
}

/// Label of a Node: what its link to the network carries, bits a second with SI units (`54M`).
pub const LINK_BANDWIDTH: &str = "muster.dev/link-bandwidth";

impl TaskSeen {
    /// A task that the application controls; none: another does.
    #[must_use]
    pub fn of(task: &Task, application: &Owner<'_>) -> Option<Self> {
        let view = TaskView::of(task, application, &LabelSelector::default())?;
        let reserved = task.spec.resources.reserved();
        (view.claim == Claim::Mine).then(|| TaskSeen {
            uid: task.metadata.uid.clone().unwrap_or_default(),
            view,
            reserves: (reserved.cpu.cores(), reserved.memory.0 as f64),
            standby: task.spec.standby.map(|standby| standby.after.as_duration()),
            used: None,
            tells: Vec::new(),
        })
    }
}

impl NodeSeen {
    /// What a Node says; what is measured of its link is for the caller to add.
    #[must_use]
    pub fn of(node: &Node) -> Self {
        let passing = NodeFacts::of(node).passing;
        let status = node.status.clone().unwrap_or_default();
        let amount = |compute: &muster_api::resource::Compute| {
            (compute.cpu.cores(), compute.memory.0 as f64)
        };
        let labels = node.metadata.labels.as_ref();
        let declared = labels.and_then(|labels| labels.get(LINK_BANDWIDTH));
        let declared = declared.and_then(|text| text.parse::<muster_api::quantity::BitRate>().ok());
        NodeSeen {
            view: NodeView::of(node),
            passing,
            free: amount(&status.free),
            allocatable: amount(&status.allocatable),
            link: LinkSeen { bandwidth: declared.map(|rate| rate.0 as f64), ..LinkSeen::default() },
            unheard: status.unheard_since.is_some(),
        }
    }
}
