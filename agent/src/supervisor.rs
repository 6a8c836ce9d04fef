//! All drivers: starts one per task, routes to them, and joins them at the end.

use std::collections::BTreeMap;
use std::sync::Arc;

use muster_agent_core::plan::{self, Skipped, Step};
use muster_agent_core::workload::Event;
use muster_api::id::TaskUid;
use muster_api::kind::task::TaskSpec;
use muster_api::wire::agent::v1 as proto;
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use crate::assigned::decode;
use crate::checkpoint::{Assignment, Framework, Record};
use crate::driver::{Begin, Message, Shared, drive};

/// All tasks of this node.
#[derive(Debug)]
pub(crate) struct Supervisor {
    shared: Arc<Shared>,
    tasks: BTreeMap<TaskUid, Task>,
    /// Every driver; the result is its task.
    drivers: JoinSet<TaskUid>,
}

#[derive(Debug)]
struct Task {
    inbox: mpsc::UnboundedSender<Message>,
    forgotten: bool,
}

impl Supervisor {
    pub(crate) fn new(shared: Arc<Shared>) -> Supervisor {
        Supervisor { shared, tasks: BTreeMap::new(), drivers: JoinSet::new() }
    }

    /// Takes up the tasks of an earlier life of the agent.
    pub(crate) fn restore(&mut self, records: Vec<Record>) {
        for record in records {
            let uid = record.workload.uid.clone();
            let forgotten = record.workload.forgotten;
            self.start(uid, forgotten, Begin::restore(&self.shared, record));
        }
    }

    fn start(&mut self, uid: TaskUid, forgotten: bool, begin: Begin) {
        // Unbounded: what comes in is bounded by what the controller assigns, and a driver that
        // waits for its disk must not hold up the others.
        let (inbox, messages) = mpsc::unbounded_channel();
        self.tasks.insert(uid.clone(), Task { inbox, forgotten });
        let shared = Arc::clone(&self.shared);
        self.drivers.spawn(async move {
            drive(shared, begin, messages).await;
            uid
        });
    }

    /// Takes the controller's assignments.
    pub(crate) fn assign(&mut self, message: proto::Assignments) {
        let known = |uid: &TaskUid| self.tasks.contains_key(uid);
        let (assignments, mut details) = decode(message, known, assignment);
        let known = self.tasks.iter().map(|(uid, task)| (uid.clone(), task.forgotten)).collect();
        let plan = plan::plan(assignments, &known);
        for skipped in plan.skipped {
            match skipped {
                Skipped::Unreadable(uid, why) => {
                    tracing::warn!(%uid, why, "what the controller now wants cannot be read");
                }
                skipped => tracing::debug!(?skipped, "nothing to do"),
            }
        }
        for step in plan.steps {
            match step {
                Step::Create(uid, desired) => {
                    let Some(assignment) = details.remove(&uid) else { continue };
                    tracing::info!(%uid, task = %assignment.name, "assigned");
                    self.start(uid.clone(), false, Begin::New(uid, Box::new(assignment), desired));
                }
                Step::Refuse(uid, why) => {
                    let Some(assignment) = details.remove(&uid) else { continue };
                    tracing::error!(%uid, why, "an assignment cannot be read");
                    self.start(uid.clone(), false, Begin::Unreadable(uid, assignment.into(), why));
                }
                Step::Tell(uid, Event::Assigned(desired)) => {
                    let Some(assignment) = details.remove(&uid) else { continue };
                    self.tell(&uid, Message::Assigned(Box::new(assignment), desired));
                }
                Step::Tell(uid, event) => {
                    if let (Event::Forgotten, Some(task)) = (&event, self.tasks.get_mut(&uid)) {
                        task.forgotten = true;
                    }
                    self.tell(&uid, Message::Event(event));
                }
            }
        }
    }

    /// Contact is back: tasks that wait for it may start.
    pub(crate) fn tick(&self) {
        for uid in self.tasks.keys() {
            self.tell(uid, Message::Event(Event::Tick));
        }
    }

    /// The gate heard nothing of this task, which drove, and gives its right to drive back.
    pub(crate) fn give_back(&self, uid: &TaskUid) {
        tracing::warn!(%uid, "whoever drives is silent for too long; its task is ended");
        self.tell(uid, Message::Event(Event::GivenBack));
    }

    fn tell(&self, uid: &TaskUid, message: Message) {
        if let Some(task) = self.tasks.get(uid) {
            // Closed: the driver has just dropped its task.
            let _ = task.inbox.send(message);
        }
    }

    /// Resolves when a driver has ended, and takes it out. Cancel-safe: `join_next` is.
    pub(crate) async fn ended(&mut self) {
        match self.drivers.join_next().await {
            Some(Ok(uid)) => {
                self.tasks.remove(&uid);
            }
            Some(Err(error)) => {
                // A driver that panicked leaves its task's processes alone; the next life of the
                // agent takes them up again.
                tracing::error!(%error, "a task's driver ended unexpectedly");
            }
            None => std::future::pending().await,
        }
    }

    /// Lets all drivers end; their tasks' processes stay.
    pub(crate) async fn shut_down(mut self) {
        self.tasks.clear();
        while self.drivers.join_next().await.is_some() {}
    }
}

fn assignment(wire: &proto::Assignment, spec: TaskSpec) -> Assignment {
    let framework = wire.framework.clone();
    Assignment {
        namespace: wire.namespace.clone(),
        name: wire.name.clone(),
        spec,
        lease: wire.lease.as_ref().map(lease_text),
        framework: framework.map(|proto::Framework { id, name }| Framework { id, name }),
        given: wire.config.clone().map(Arc::new),
    }
}

fn lease_text(lease: &proto::LeaseToken) -> String {
    let sequence: Vec<String> = lease.sequence.iter().map(ToString::to_string).collect();
    let base = format!("{}.{}:{}", lease.node, lease.group, lease.epoch);
    if sequence.is_empty() { base } else { format!("{base},{}", sequence.join(",")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leases_as_text() {
        let lease = proto::LeaseToken {
            node: "tb-1".to_owned(),
            group: "body".to_owned(),
            epoch: 6,
            sequence: vec![],
        };
        assert_eq!(lease_text(&lease), "tb-1.body:6");
    }
}
