//! All drivers: starts one per task, routes to them, and joins them at the end.

use std::collections::BTreeMap;
use std::sync::Arc;

use muster_agent_core::depend::Dependency;
use muster_agent_core::desired::{Desired, StopOrder};
use muster_agent_core::plan::{self, Assignments, Skipped, Step};
use muster_agent_core::workload::Event;
use muster_api::id::TaskUid;
use muster_api::wire::WireError;
use muster_api::wire::agent::v1 as proto;
use muster_api::wire::agent_session::dependency_condition_from_wire;
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use crate::checkpoint::{Assignment, Framework, Record};
use crate::driver::{Begin, Message, Shared, drive};
use crate::spec;

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
        let (assignments, mut details) = decode(message, &self.tasks);
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

type Details = BTreeMap<TaskUid, Assignment>;

fn decode(message: proto::Assignments, known: &BTreeMap<TaskUid, Task>) -> (Assignments, Details) {
    let mut assignments = Assignments {
        complete: message.complete,
        released: message.released.into_iter().map(TaskUid::new).collect(),
        kept: message.kept.into_iter().map(TaskUid::new).collect(),
        ..Assignments::default()
    };
    let mut details = BTreeMap::new();
    for wire in message.upserts {
        let uid = TaskUid::new(wire.uid);
        if !is_file_name(&uid) {
            tracing::error!(%uid, "an assignment's uid is refused");
            continue;
        }
        if wire.ended && !known.contains_key(&uid) {
            // Nothing of it is here, and it must not begin.
            continue;
        }
        let assignment = |spec| Assignment {
            namespace: wire.namespace.clone(),
            name: wire.name.clone(),
            spec,
            lease: wire.lease.as_ref().map(lease_text),
            framework: wire
                .framework
                .clone()
                .map(|proto::Framework { id, name }| Framework { id, name }),
            given: wire.config.clone().map(Arc::new),
        };
        let task_spec = match spec::read(&wire.spec) {
            Ok(task_spec) => task_spec,
            Err(error) => {
                details.insert(uid.clone(), assignment(spec::nothing()));
                assignments.unreadable.insert(uid, error.to_string());
                continue;
            }
        };
        let mut stop = wire.stop.as_ref().map(|stop| StopOrder {
            grace_ms: stop.grace_period_ms.into(),
            reason: stop.reason.clone(),
        });
        if wire.ended {
            let grace_ms = u64::from(task_spec.grace_period_seconds) * 1_000;
            let reason = "its end is recorded".to_owned();
            stop = stop.or(Some(StopOrder { grace_ms, reason }));
        }
        let depends: Result<Vec<Dependency>, WireError> =
            wire.dependencies.iter().map(dependency).collect();
        let depends = match depends {
            Ok(depends) => depends,
            Err(error) => {
                details.insert(uid.clone(), assignment(spec::nothing()));
                assignments.unreadable.insert(uid, error.to_string());
                continue;
            }
        };
        let attempts = Some(wire.attempts).filter(|attempts| *attempts > 0);
        let desired = Desired { depends, attempts, ..spec::desired(&task_spec, stop) };
        assignments.upserts.insert(uid.clone(), desired);
        details.insert(uid, assignment(task_spec));
    }
    (assignments, details)
}

fn dependency(wire: &proto::Dependency) -> Result<Dependency, WireError> {
    Ok(Dependency {
        task: wire.task.clone(),
        uid: wire.uid.clone(),
        condition: dependency_condition_from_wire(wire.condition)?,
        restart: wire.restart,
        unmet: (!wire.met).then(|| wire.unmet.clone()),
        attempt: wire.attempt,
    })
}

/// A uid names a directory and a group: it must not lead out of them.
fn is_file_name(uid: &TaskUid) -> bool {
    let text = uid.as_str();
    !text.is_empty()
        && text.len() <= 200
        && !text.starts_with('.')
        && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte))
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
    fn uids_stay_in_their_directory() {
        for good in ["a", "0f3c-1", "a.b"] {
            assert!(is_file_name(&TaskUid::new(good)), "{good}");
        }
        for bad in ["", "..", ".a", "a/b", "a b", "ü"] {
            assert!(!is_file_name(&TaskUid::new(bad)), "{bad}");
        }
    }

    #[test]
    fn a_recorded_end_never_begins() {
        let wire = proto::Assignment {
            uid: "a".to_owned(),
            spec: br#"{"run":{"process":{"command":["true"]}}}"#.to_vec(),
            ended: true,
            ..proto::Assignment::default()
        };
        let message =
            proto::Assignments { complete: true, upserts: vec![wire], ..Default::default() };
        let (assignments, _) = decode(message.clone(), &BTreeMap::new());
        assert!(assignments.upserts.is_empty());
        let (inbox, _messages) = mpsc::unbounded_channel();
        let known = BTreeMap::from([(TaskUid::new("a"), Task { inbox, forgotten: false })]);
        let (assignments, _) = decode(message, &known);
        assert!(assignments.upserts[&TaskUid::new("a")].stop.is_some());
    }

    #[test]
    fn what_cannot_be_read_is_named_with_its_field() {
        let cases: [(&[u8], &str); 5] = [
            (br#"{"run":{"wasm":{"module":"x"}}}"#, "wasm"),
            (br#"{"run":{}}"#, "run"),
            (br#"{"run":{"process":{}}}"#, "run.process: missing field `command`"),
            (
                br#"{"run":{"process":{"command":["true"]}},"restartPolicy":"Hourly"}"#,
                "restartPolicy",
            ),
            (b"not json", "assignment.spec"),
        ];
        for (spec, field) in cases {
            let wire = proto::Assignment {
                uid: "a".to_owned(),
                name: "t".to_owned(),
                spec: spec.to_vec(),
                ..proto::Assignment::default()
            };
            let message = proto::Assignments { upserts: vec![wire], ..Default::default() };
            let (assignments, details) = decode(message, &BTreeMap::new());
            let why = &assignments.unreadable[&TaskUid::new("a")];
            assert!(why.contains(field), "{why}");
            assert!(assignments.upserts.is_empty());
            assert_eq!(details[&TaskUid::new("a")].name, "t");
        }
    }

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
