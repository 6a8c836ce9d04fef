//! What a TaskSet among planned objects would do: which tasks it would begin, end and change. The reconciler's own core
//! decides, as if the set were stored; nothing is.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use muster_api::id::TaskUid;
use muster_api::kind::namespace::DEFAULT;
use muster_api::kind::node::Node;
use muster_api::kind::task::{Task, TaskSpec};
use muster_api::kind::taskset::{SET_LABEL, Strategy, TaskSet};
use muster_api::kind::taskset_revision::TaskSetRevision;
use muster_controller_core::schedule::Demand;
use muster_controller_core::taskset::view::{Claim, NodeView, RevisionView, TaskView};
use muster_controller_core::taskset::{AT_ONCE, Action, Ending, NewTask, Plan, Snapshot, plan};
use serde_json::{Value, json};

use super::failure::Failure;
use crate::context::Context;
use crate::objects::{self, NODES, REVISIONS, TASK_SETS, TASKS};
use crate::reconcile::owned::as_owner;
use crate::reconcile::taskset::spec_at;
use crate::store::{Key, Store, Stored};

/// What is there that a set looks at.
struct There {
    tasks: Vec<TaskView>,
    revisions: Vec<RevisionView>,
    nodes: BTreeMap<String, NodeView>,
    taken: BTreeSet<String>,
}

/// What becomes of a set, for people, and the tasks that it would begin, to be placed by the scheduler.
pub(super) fn outcome(context: &Context, object: &Value) -> Result<(Value, Vec<Demand>), Failure> {
    let set: TaskSet = serde_json::from_value(object.clone()).map_err(|error| {
        Failure::bad_request(format!("a TaskSet does not read as one: {error}"))
    })?;
    let namespace = set.metadata.namespace.clone().unwrap_or_else(|| DEFAULT.to_owned());
    let name = set.metadata.name.clone().unwrap_or_default();
    let stored = context.store.get(&Key::namespaced(TASK_SETS, &*namespace, &*name));
    let present: Option<TaskSet> = stored.as_ref().and_then(|stored| objects::read(stored));
    let uid = stored.map(|stored| stored.uid.to_string()).unwrap_or_default();
    let there = there(&context.store, (&namespace, &name), &uid, &set);
    let status = present.and_then(|set| set.status).unwrap_or_default();
    let snapshot = Snapshot {
        name: &name,
        spec: &set.spec,
        generation: 0,
        status: &status,
        revisions: &there.revisions,
        tasks: &there.tasks,
        nodes: &there.nodes,
        silent: const { &BTreeMap::new() },
        taken: &there.taken,
    };
    let plan = plan(&snapshot, context.clock.now());
    let new = begins(&set, &there, &plan);
    let demand = |(i, (new, spec)): (usize, (&NewTask, _))| Demand {
        uid: TaskUid::new(format!("plan-{namespace}-{}", new.name)),
        title: format!("{namespace}/{}", new.name).into(),
        spec: Arc::new(spec),
        framework: None,
        // After every task of its own.
        since: u64::MAX / 2 + (1 << 32) + i as u64,
        avoid: Arc::default(),
    };
    let names: Vec<&str> = new.iter().map(|(new, _)| new.name.as_str()).collect();
    let task = |name: &str| told(&context.store, &there, &namespace, name);
    let (changes, held) = changes(&set, &there, &plan);
    let ends = plan.actions.iter().filter_map(|action| match action {
        Action::Delete { why: Ending::Outdated { .. }, .. } => None,
        Action::Delete { task: name, why } => {
            let mut told = task(name);
            told["why"] = why.to_string().into();
            Some(told)
        }
        _ => None,
    });
    // What one transaction begins; the rest follows when these are there.
    let (desired, stay) = (plan.status.desired_replicas, plan.status.replicas);
    let here = stay.saturating_add(u32::try_from(names.len()).unwrap_or(u32::MAX));
    let later = if names.len() < AT_ONCE { 0 } else { desired.saturating_sub(here) };
    let answer = json!({
        "namespace": namespace, "name": name, "begins": names, "later": later,
        "changes": changes.into_iter().map(task).collect::<Vec<_>>(),
        "first": set.spec.rollout.canary,
        "ends": ends.collect::<Vec<_>>(),
        "held": held.into_iter().map(task).collect::<Vec<_>>(),
    });
    let demands = new.into_iter().enumerate().map(demand).collect();
    Ok((answer, demands))
}

fn there(store: &Store, (namespace, name): (&str, &str), uid: &str, set: &TaskSet) -> There {
    let selector = set.spec.selects(name);
    let all = store.list(TASKS, Some(namespace)).items;
    let key = Key::namespaced(TASK_SETS, namespace, name);
    let owner = as_owner(&key, uid, "TaskSet");
    let views =
        all.iter().filter_map(|s| TaskView::of(&objects::read::<Task>(s)?, &owner, &selector));
    let tasks: Vec<TaskView> = views.collect();
    let prefix = format!("{name}-");
    let others = all.iter().map(|stored| stored.key.name.to_string());
    let others = others.filter(|n| n.starts_with(&prefix) && tasks.iter().all(|t| t.name != *n));
    let revisions = store.list(REVISIONS, Some(namespace)).items.into_iter();
    let of_set = revisions.filter(|s| s.labels().get(SET_LABEL).is_some_and(|n| n == name));
    let of_set = of_set.filter_map(|s| objects::read::<TaskSetRevision>(&s));
    let nodes = store.list(NODES, None).items.into_iter();
    let node =
        |s: Arc<Stored>| Some((s.key.name.to_string(), NodeView::of(&objects::read::<Node>(&s)?)));
    There {
        taken: others.collect(),
        revisions: of_set.filter_map(|revision| RevisionView::of(&revision, &owner)).collect(),
        nodes: nodes.filter_map(node).collect(),
        tasks,
    }
}

fn begins<'p>(set: &TaskSet, there: &There, plan: &'p Plan) -> Vec<(&'p NewTask, TaskSpec)> {
    let name = set.metadata.name.as_deref().unwrap_or_default();
    let template = |new: &NewTask| {
        let kept = there.revisions.iter().find(|revision| revision.name == new.revision);
        kept.map_or(&set.spec.template, |kept| &kept.template)
    };
    let new = plan.actions.iter().filter_map(|action| match action {
        Action::Create(new) => Some(new),
        _ => None,
    });
    new.map(|new| (new, spec_at(&set.spec, name, new, template(new).spec.clone()))).collect()
}

/// Tasks that the rollout changes, one after the other, and those that a mission keeps as they are for now.
fn changes<'t>(set: &TaskSet, there: &'t There, plan: &Plan) -> (Vec<&'t str>, Vec<&'t str>) {
    let rollout = &set.spec.rollout;
    let stays = rollout.paused || rollout.strategy == Strategy::OnDelete;
    if stays || plan.status.rolled_back_from.is_some() {
        return (Vec::new(), Vec::new());
    }
    let kept = |task: &TaskView| {
        let ends = |action: &Action| match action {
            Action::Delete { task: ended, why } => {
                *ended == task.name && !matches!(why, Ending::Outdated { .. })
            }
            _ => false,
        };
        task.claim == Claim::Mine
            && !task.ending
            && !task.phase.is_terminal()
            && !plan.actions.iter().any(ends)
    };
    let old = there.tasks.iter().filter(|t| kept(t) && t.revision != plan.status.update_revision);
    let locked = |task: &&TaskView| {
        let node = task.node.as_ref().and_then(|node| there.nodes.get(node));
        node.is_some_and(|node| node.lock.is_some())
    };
    let (held, changed): (Vec<&TaskView>, Vec<&TaskView>) = old.partition(locked);
    let names = |tasks: Vec<&'t TaskView>| tasks.into_iter().map(|t| t.name.as_str()).collect();
    (names(changed), names(held))
}

/// A task that is there: where, what holds it, and the lease that it loses with its end.
fn told(store: &Store, there: &There, namespace: &str, name: &str) -> Value {
    let view = there.tasks.iter().find(|task| task.name == name);
    let node = view.and_then(|task| task.node.clone());
    let lock = node.as_ref().and_then(|node| there.nodes.get(node)?.lock.clone());
    json!({
        "task": name, "node": node, "leases": leases_of(store, namespace, name),
        "lock": lock.map(|lock| format!("{}: {}", lock.holder, lock.reason)),
    })
}

/// Names of the leases that a task holds.
pub(super) fn leases_of(store: &Store, namespace: &str, name: &str) -> Vec<String> {
    let stored = store.get(&Key::namespaced(TASKS, namespace, name));
    let held = stored.filter(|stored| stored.mentions("lease"));
    let status = held.and_then(|stored| objects::read::<Task>(&stored)?.status);
    status.and_then(|status| status.lease).map(|lease| lease.name).into_iter().collect()
}
