//! Writes into Applications what follows from them and from the nodes that there are: which parts may move and why the
//! others may not, where, and how many mappings are left.
//!
//! It does no more: no task is created, no link measured, nothing moved, and the condition `Managed` says so. What would be
//! done is `muster_controller_core::offload::plan`.

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use muster_api::condition::{
    CHARACTERISED, Condition, ConditionStatus, FITS_HOME, MANAGED, set_condition,
};
use muster_api::kind::application::{Application, ApplicationStatus, PartClass, PartStatus};
use muster_api::kind::node::{Node, NodeKind};
use muster_api::selector::Labels;
use muster_controller_core::offload::constraint::Resource;
use muster_controller_core::offload::model::Model;
use muster_controller_core::offload::reason::{Stand, amount};

use super::{again, next_events, watch_from_now};
use crate::context::Context;
use crate::objects::{self, APPLICATIONS, NODES};
use crate::store::{Key, Op, StoreError};

/// Between two looks: nodes change all the time, and who looks at an application does not see the difference.
const EVERY: Duration = Duration::from_millis(250);

/// Works until dropped.
pub async fn run(context: Arc<Context>) {
    again(&context, "applications are not looked at", follow).await;
}

/// Looks at every application whenever one of them or a node changes; ends when it must begin anew.
async fn follow(context: &Context) -> Result<(), StoreError> {
    let mut watcher = watch_from_now(&context.store).await;
    loop {
        look(context).await?;
        tokio::time::sleep(EVERY).await;
        loop {
            // Cancel safe: this is only dropped when the controller ends.
            let Some(events) = next_events(&mut watcher).await else { return Ok(()) };
            let ours = |key: &Key| key.resource == APPLICATIONS || key.resource == NODES;
            if events.iter().any(|event| ours(&event.object.key)) {
                break;
            }
        }
    }
}

async fn look(context: &Context) -> Result<(), StoreError> {
    let applications = context.store.list(APPLICATIONS, None).items;
    if applications.is_empty() {
        return Ok(());
    }
    let nodes: Vec<Node> =
        context.store.list(NODES, None).items.iter().filter_map(|s| objects::read(s)).collect();
    for stored in applications {
        let now = context.clock.now();
        objects::change(&context.store, &stored.key, |stored, application: Application| {
            let status = characterise(&application, &nodes, now);
            let same = application.status.as_ref() == Some(&status);
            (!same).then(|| vec![Op::status(stored, &Some(status))])
        })
        .await?;
    }
    Ok(())
}

/// What is to be said of an application.
fn characterise(application: &Application, nodes: &[Node], now: Timestamp) -> ApplicationStatus {
    let model = Model::of(&application.spec);
    let before = application.status.clone().unwrap_or_default();
    let scales = scales(application, nodes);
    let (all, allowed) = model.mappings(scales.len() + 1);
    let part = |part: &muster_controller_core::offload::model::PartModel| {
        let stand = Stand::Pinned(part.pins.clone());
        let old = before.part(&part.name).cloned().unwrap_or_default();
        let mut status = PartStatus {
            name: part.name.clone(),
            pinned: part.pins.iter().map(Into::into).collect(),
            class: if part.may_move() { PartClass::Migratable } else { PartClass::Critical },
            ..old
        };
        if part.may_move() {
            status.reason = "MayMove".to_owned();
            status.message = "may run at home and on the application's scales".to_owned();
        } else {
            (status.reason, status.message) = (stand.reason().to_owned(), stand.to_string());
        }
        status
    };
    let mut status = ApplicationStatus {
        observed_generation: application.metadata.generation.unwrap_or_default(),
        parts: model.parts.iter().map(part).collect(),
        scales,
        mappings: number(all),
        allowed_mappings: number(allowed),
        ..before
    };
    let ready = Condition::new(CHARACTERISED, true, "Characterised", String::new());
    for condition in [ready, fits_home(application, &model, nodes), managed()] {
        set_condition(&mut status.conditions, condition, &Time(now));
    }
    status
}

fn managed() -> Condition {
    let message =
        "this version of muster works out where the parts may run, and does not run or move them";
    Condition::new(MANAGED, false, "NotRun", message)
}

/// The nodes where parts may run besides home.
fn scales(application: &Application, nodes: &[Node]) -> Vec<String> {
    let spec = &application.spec.scales;
    let nothing = Labels::default();
    let named = |node: &&Node| {
        let name = objects::node_name(node);
        let labels = node.metadata.labels.as_ref().unwrap_or(&nothing);
        let by_selector = spec.selector.as_ref().is_some_and(|s| s.matches(labels));
        let by_kind =
            spec.nodes.is_empty() && spec.selector.is_none() && node.spec.kind == NodeKind::Cloud;
        let by_name = spec.nodes.iter().any(|n| n == name);
        name != application.spec.home && (by_name || by_selector || by_kind)
    };
    nodes.iter().filter(named).map(|node| objects::node_name(node).to_owned()).collect()
}

/// Whether everything could be at home at once.
fn fits_home(application: &Application, model: &Model, nodes: &[Node]) -> Condition {
    let home = &application.spec.home;
    let node = nodes.iter().find(|node| objects::node_name(node) == home);
    let Some(status) = node.map(|node| node.status.clone().unwrap_or_default()) else {
        let message = format!("there is no node {home}; `muster get nodes` lists them");
        return Condition::new(FITS_HOME, false, "NoSuchNode", message);
    };
    let (cpu, memory) = model.home_need();
    let (has_cpu, has_memory) =
        (status.allocatable.cpu.cores(), status.allocatable.memory.0 as f64);
    for (resource, need, have) in
        [(Resource::Cpu, cpu, has_cpu), (Resource::Memory, memory, has_memory)]
    {
        if need > have {
            let (need, have) = (amount(resource, need), amount(resource, have));
            let message = format!(
                "all parts together need {need}, {home} has {have}: they could not all come home"
            );
            return Condition::new(FITS_HOME, false, "HomeTooSmall", message);
        }
    }
    Condition::new(FITS_HOME, ConditionStatus::True, "Fits", String::new())
}

/// Whole while that is exact enough to read.
fn number(count: f64) -> String {
    if count < 1e9 { format!("{count:.0}") } else { format!("{count:.1e}") }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn node(name: &str, kind: &str, cpu: &str) -> Node {
        serde_json::from_value(json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Node", "metadata": {"name": name},
            "spec": {"kind": kind}, "status": {"allocatable": {"cpu": cpu, "memory": "2Gi"}},
        }))
        .expect("a Node")
    }

    fn application(scales: serde_json::Value) -> Application {
        let part = |name: &str, sensors: serde_json::Value| {
            json!({
                "name": name, "cpu": "500m",
                "template": {"spec": {"resources": {"sensors": sensors}, "run": {"process": {"command": ["x"]}}}},
            })
        };
        serde_json::from_value(json!({
            "apiVersion": "muster.dev/v1alpha1", "kind": "Application", "metadata": {"name": "a", "generation": 3},
            "spec": {
                "home": "r1", "scales": scales,
                "parts": [part("camera", json!(["xtion:ImageGen"])), part("ar", json!([]))],
            },
        }))
        .expect("an Application")
    }

    #[test]
    fn the_status_says_what_may_move_where_and_that_nothing_does() {
        let nodes = [node("r1", "Robot", "2"), node("c1", "Cloud", "8"), node("r2", "Robot", "2")];
        let now = Timestamp::UNIX_EPOCH;
        let status = characterise(&application(json!({})), &nodes, now);
        assert_eq!(status.observed_generation, 3);
        assert_eq!(status.scales, ["c1"]);
        let classes: Vec<PartClass> = status.parts.iter().map(|p| p.class).collect();
        assert_eq!(classes, [PartClass::Critical, PartClass::Migratable]);
        assert_eq!(status.parts[0].message, "stays at home: it reads the sensor xtion:ImageGen");
        assert_eq!((&*status.mappings, &*status.allowed_mappings), ("4", "2"));
        let is = |r#type| status.condition(r#type).map(|c| c.status);
        assert_eq!(is(CHARACTERISED), Some(ConditionStatus::True));
        assert_eq!(is(FITS_HOME), Some(ConditionStatus::True));
        assert_eq!(is(MANAGED), Some(ConditionStatus::False));
        // Nothing changes, nothing is written.
        let mut again = application(json!({}));
        again.status = Some(status.clone());
        assert_eq!(characterise(&again, &nodes, now), status);
    }

    #[test]
    fn a_home_that_is_not_there_or_too_small_is_said() {
        let now = Timestamp::UNIX_EPOCH;
        let why = |nodes: &[Node]| {
            let status = characterise(&application(json!({"nodes": ["r2"]})), nodes, now);
            let condition = status.condition(FITS_HOME).cloned().expect("a condition");
            (condition.reason, condition.message, status.scales)
        };
        let (reason, _, scales) = why(&[node("r2", "Robot", "2")]);
        assert_eq!((&*reason, scales), ("NoSuchNode", vec!["r2".to_owned()]));
        let (reason, message, _) = why(&[node("r1", "Robot", "900m")]);
        assert_eq!(reason, "HomeTooSmall");
        assert_eq!(
            message,
            "all parts together need 1 cpu, r1 has 900m cpu: they could not all come home"
        );
    }
}
