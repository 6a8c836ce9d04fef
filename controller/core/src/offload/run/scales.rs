//! Where parts can be: home first, then the scales of the spec, then nodes where tasks of the application still are.

use std::time::Duration;

use jiff::Timestamp;
use muster_api::kind::application::ApplicationSpec;
use muster_api::kind::node::{NodeKind, Taint, TaintEffect};

use super::Snapshot;
use super::view::NodeSeen;
use crate::offload::view::{LinkView, ScaleView};
use crate::taskset::after;

/// What a node that nobody has measured is away from the network, seconds one way.
const UNKNOWN_LATENCY: f64 = 0.0;

/// The scales of a look.
#[derive(Debug, Clone, PartialEq)]
pub struct Scales {
    /// Home, then the others.
    pub views: Vec<ScaleView>,
    /// How many of them the spec names, home included; on the others is only what is left there.
    pub named: usize,
    /// Nobody knows for how long home has been silent (see [`NodeSeen::unheard`]).
    pub home_unheard: bool,
}

impl Scales {
    pub(super) fn of(snapshot: &Snapshot<'_>, now: Timestamp) -> Self {
        let spec = snapshot.spec;
        let mut names: Vec<&str> = vec![&spec.home];
        let others = snapshot.nodes.iter().filter(|(name, node)| is_scale(spec, name, node));
        names.extend(others.map(|(name, _)| name.as_str()));
        let named = names.len();
        for attempt in snapshot.status.parts.iter().flat_map(|part| part.tasks()) {
            if !names.contains(&attempt.scale.as_str()) {
                names.push(&attempt.scale);
            }
        }
        let mut views: Vec<ScaleView> =
            names.iter().map(|name| scale(snapshot, name, now)).collect();
        for view in &mut views[named..] {
            view.unfit.get_or_insert_with(|| "it is none of the application's scales".to_owned());
        }
        let home_unheard = snapshot.nodes.get(&spec.home).is_some_and(|home| home.unheard);
        Scales { views, named, home_unheard }
    }

    /// The index of a node.
    pub(super) fn index(&self, name: &str) -> Option<usize> {
        self.views.iter().position(|view| view.name == name)
    }
}

/// Whether parts may run on a node besides home.
#[must_use]
pub fn is_scale(spec: &ApplicationSpec, name: &str, node: &NodeSeen) -> bool {
    let (scales, facts) = (&spec.scales, &node.view.facts);
    let by_selector = scales.selector.as_ref().is_some_and(|s| s.matches(&facts.labels));
    let by_kind =
        scales.nodes.is_empty() && scales.selector.is_none() && facts.kind == NodeKind::Cloud;
    let by_name = scales.nodes.iter().any(|n| n == name);
    name != spec.home && (by_name || by_selector || by_kind)
}

fn scale(snapshot: &Snapshot<'_>, name: &str, now: Timestamp) -> ScaleView {
    let node = snapshot.nodes.get(name);
    let (cpu, memory) = node.map_or((0.0, 0.0), |node| room(snapshot, name, node));
    ScaleView {
        name: name.to_owned(),
        gain: gain(snapshot, name, node),
        cpu,
        memory,
        unfit: match node {
            Some(node) => unfit(snapshot.spec, node, now),
            None => Some("there is no such node".to_owned()),
        },
        link: link(node, now),
    }
}

/// The paper's α.
fn gain(snapshot: &Snapshot<'_>, name: &str, node: Option<&NodeSeen>) -> f64 {
    if name == snapshot.spec.home {
        return 1.0;
    }
    let cores = |node: Option<&NodeSeen>| node.map_or(0.0, |node| node.allocatable.0);
    let home = cores(snapshot.nodes.get(&snapshot.spec.home));
    let ratio = if home > 0.0 { cores(node) / home } else { 1.0 };
    snapshot.spec.scales.gains.get(name).copied().unwrap_or_else(|| ratio.max(1.0))
}

/// What is free there, and what the application's own tasks hold.
fn room(snapshot: &Snapshot<'_>, name: &str, node: &NodeSeen) -> (f64, f64) {
    let own = snapshot
        .tasks
        .values()
        .filter(|task| task.view.phase.holds_node() && task.view.node.as_deref() == Some(name));
    let add = |(cpu, memory): (f64, f64), (c, m): (f64, f64)| (cpu + c, memory + m);
    own.map(|task| task.reserves).fold(node.free, add)
}

/// Why nothing new runs there and nothing should stay. A node that is silent is for its connections' tolerance to judge;
/// what has none waits for the cool-down, or as long as the most patient connection.
fn unfit(spec: &ApplicationSpec, node: &NodeSeen, now: Timestamp) -> Option<String> {
    let facts = &node.view.facts;
    if facts.unschedulable {
        return Some("it is cordoned".to_owned());
    }
    let keeps_away = |taint: &&Taint| taint.effect != TaintEffect::PreferNoSchedule;
    if let Some(taint) = node.passing.iter().find(keeps_away) {
        return Some(format!("it is out of service for now: {}", taint.key));
    }
    let not_ready = facts.not_ready.as_ref()?;
    let Some(silent) = node.view.silent_since else {
        return Some(format!("it is not ready: {not_ready}"));
    };
    let tolerated = spec.connections.iter().filter(|c| c.min_hz.is_some()).map(|c| c.tolerance);
    let patience = tolerated.chain([spec.cooldown]).map(|span| span.as_duration()).max();
    let given_up = after(silent, patience.unwrap_or_default());
    (given_up <= now).then(|| format!("it is not heard since {silent}"))
}

fn link(node: Option<&NodeSeen>, now: Timestamp) -> LinkView {
    let up = node.is_some_and(|node| node.view.facts.not_ready.is_none());
    let since = match node {
        Some(node) if up => node.view.ready_since,
        Some(node) => node.view.silent_since,
        None => None,
    };
    let measured = node.map(|node| node.link).unwrap_or_default();
    let one_way = |trip: Duration| trip.as_secs_f64() / 2.0;
    LinkView {
        up,
        since: since.unwrap_or(now).min(now),
        bandwidth: measured.bandwidth.unwrap_or(f64::INFINITY),
        latency: measured.round_trip.map_or(UNKNOWN_LATENCY, one_way),
    }
}
