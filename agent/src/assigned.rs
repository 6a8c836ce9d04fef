//! Assignments: wire form → what the core decides on, and beside it what whoever carries that out keeps of each task.
//! Pure; the simulation in `tests/` uses it as the supervisor does.

use std::collections::BTreeMap;

use muster_agent_core::depend::Dependency;
use muster_agent_core::desired::{Desired, StopOrder};
use muster_agent_core::plan::Assignments;
use muster_api::id::TaskUid;
use muster_api::kind::task::TaskSpec;
use muster_api::wire::WireError;
use muster_api::wire::agent::v1 as proto;
use muster_api::wire::agent_session::dependency_condition_from_wire;

use crate::spec;

/// Decodes a message. `is_known`: the task is on this node. `keep` makes what is kept of a task of its assignment, whose
/// spec is read; a spec that cannot be read asks for nothing, and its task is never launched.
pub fn decode<T>(
    message: proto::Assignments,
    is_known: impl Fn(&TaskUid) -> bool,
    keep: impl Fn(&proto::Assignment, TaskSpec) -> T,
) -> (Assignments, BTreeMap<TaskUid, T>) {
    let mut assignments = Assignments {
        complete: message.complete,
        released: message.released.into_iter().map(TaskUid::new).collect(),
        kept: message.kept.into_iter().map(TaskUid::new).collect(),
        ..Assignments::default()
    };
    let mut kept = BTreeMap::new();
    for wire in message.upserts {
        let uid = TaskUid::new(wire.uid.clone());
        if !is_file_name(&uid) {
            tracing::error!(%uid, "an assignment's uid is refused");
            continue;
        }
        if wire.ended && !is_known(&uid) {
            // Nothing of it is here, and it must not begin.
            continue;
        }
        match read(&wire) {
            Ok((task_spec, desired)) => {
                assignments.upserts.insert(uid.clone(), desired);
                kept.insert(uid, keep(&wire, task_spec));
            }
            Err(error) => {
                kept.insert(uid.clone(), keep(&wire, spec::nothing()));
                assignments.unreadable.insert(uid, error.to_string());
            }
        }
    }
    (assignments, kept)
}

fn read(wire: &proto::Assignment) -> Result<(TaskSpec, Desired), WireError> {
    let task_spec = spec::read(&wire.spec)?;
    let mut stop = wire.stop.as_ref().map(|stop| StopOrder {
        grace_ms: stop.grace_period_ms.into(),
        reason: stop.reason.clone(),
    });
    if wire.ended {
        let grace_ms = u64::from(task_spec.grace_period_seconds) * 1_000;
        let reason = "its end is recorded".to_owned();
        stop = stop.or(Some(StopOrder { grace_ms, reason }));
    }
    let depends = wire.dependencies.iter().map(dependency).collect::<Result<_, _>>()?;
    let attempts = Some(wire.attempts).filter(|attempts| *attempts > 0);
    let desired = Desired { depends, attempts, ..spec::desired(&task_spec, stop) };
    Ok((task_spec, desired))
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

#[cfg(test)]
mod tests {
    use super::*;

    fn name(wire: &proto::Assignment, _: TaskSpec) -> String {
        wire.name.clone()
    }

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
        let (assignments, _) = decode(message.clone(), |_| false, name);
        assert!(assignments.upserts.is_empty());
        let (assignments, _) = decode(message, |uid| uid.as_str() == "a", name);
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
            let (assignments, kept) = decode(message, |_| false, name);
            let why = &assignments.unreadable[&TaskUid::new("a")];
            assert!(why.contains(field), "{why}");
            assert!(assignments.upserts.is_empty());
            assert_eq!(kept[&TaskUid::new("a")], "t");
        }
    }
}
