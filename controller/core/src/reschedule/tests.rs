//! Histories of failures: what they use up, how long they make a task wait, and where they end.

use muster_api::kind::task::reschedule::{MAX_ATTEMPTS, OUT_OF_RANGE};
use muster_api::kind::task::{DEADLINE_EXCEEDED, NODE_MAINTENANCE, PREEMPTED};
use muster_api::phase::TaskPhase;
use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;

fn at(second: i64) -> Timestamp {
    Timestamp::from_second(1_800_000_000 + second).expect("in range")
}

fn task(spec: Value, status: Value) -> Task {
    let mut spec = spec;
    spec["run"] = json!({"process": {"command": ["true"]}});
    serde_json::from_value(json!({
        "apiVersion": muster_api::API_VERSION, "kind": "Task", "metadata": {"name": "t", "uid": "u0"},
        "spec": spec, "status": status,
    }))
    .expect("a task")
}

/// It was on `node` and failed there.
fn fails(task: &mut Task, node: &str, attempts: u32, now: Timestamp) {
    let past = task.status.take().unwrap_or_default();
    let said = json!({
        "phase": "Failed", "node": node, "reason": "Error", "message": "exited with code 3", "exitCode": 3,
        "failedAttempts": attempts, "boundAt": now.to_string(), "finishedAt": now.to_string(),
    });
    let said: TaskStatus = serde_json::from_value(said).expect("a status");
    let TaskStatus { earlier, attempts_used, first_bound_at, .. } = past;
    task.status = Some(TaskStatus { earlier, attempts_used, first_bound_at, ..said });
}

#[test]
fn it_waits_longer_with_each_node_and_gives_up_with_a_reason_that_names_all() {
    let spec = json!({"reschedule": {"maxAttempts": 3, "backoff": "10s", "maxBackoff": "15s"}});
    let mut task = task(spec, Value::Null);
    for (i, (node, wait)) in [("a", 10), ("b", 15)].into_iter().enumerate() {
        let now = at(100 * i as i64);
        fails(&mut task, node, 1, now);
        let Step::Again(next) = step(&task, now) else { panic!("it is tried again") };
        assert_eq!(next.phase, TaskPhase::Pending);
        assert_eq!(next.not_before.as_ref().map(|t| t.0), Some(at(100 * i as i64 + wait)));
        assert_eq!(next.first_bound_at.as_ref().map(|t| t.0), Some(at(0)), "of the first node");
        assert_eq!(next.earlier.len(), i + 1);
        let until = at(100 * i as i64 + wait);
        let just_before = until.checked_sub(SignedDuration::from_millis(1)).expect("in range");
        let held = hold(&task.spec, &next, just_before).expect("it waits");
        assert_eq!(held.reason(), "BackOff");
        let words = held.to_string();
        let attempt = format!("attempt {} of 3", i + 2);
        assert!(words.starts_with(&format!("failed on {node} (Error: exited")), "{words}");
        assert!(words.ends_with(&attempt), "{words}");
        assert_eq!(hold(&task.spec, &next, until), None);
        task.status = Some(*next);
    }
    let nodes: Vec<String> =
        refusals(task.status.as_ref().expect("it has one")).into_iter().map(|r| r.node).collect();
    assert_eq!(nodes, ["a", "b"]);
    fails(&mut task, "c", 1, at(500));
    assert_eq!(
        step(&task, at(500)),
        Step::Conclude {
            reason: ATTEMPTS_EXHAUSTED,
            message:
                "3 attempts have failed, as many as may fail: 1 on a (Error: exited with code 3), \
                      1 on b (Error: exited with code 3), 1 on c (Error: exited with code 3)"
                    .to_owned()
        }
    );
    task.status.as_mut().expect("it has one").reason = ATTEMPTS_EXHAUSTED.to_owned();
    assert_eq!(step(&task, at(501)), Step::Nothing, "said once");
}

#[test]
fn who_is_tried_again_and_who_is_not() {
    let with = |extra: Value| {
        let mut spec = json!({"reschedule": {}, "restartPolicy": "OnFailure"});
        spec.as_object_mut().expect("a map").extend(extra.as_object().cloned().unwrap_or_default());
        spec
    };
    let failed = |extra: Value| {
        let mut status = json!({"phase": "Failed", "node": "n", "reason": "Error"});
        status
            .as_object_mut()
            .expect("a map")
            .extend(extra.as_object().cloned().unwrap_or_default());
        status
    };
    let stopped = |reason: &str, ended: &str| {
        let stop = json!({"reason": reason, "message": "m", "at": "2026-01-01T00:00:00Z"});
        failed(json!({"stop": stop, "reason": ended}))
    };
    let plain = || json!({});
    let radius = json!({"placement": {"onOutOfRange": "Reschedule"}});
    let over = |why| Outlook::Over(why);
    for (name, spec, status, outlook) in [
        ("not ended", with(plain()), json!({"phase": "Running", "node": "n"}), Outlook::Alive),
        ("succeeded", with(plain()), json!({"phase": "Succeeded"}), over(Over::Succeeded)),
        ("not asked for", plain(), failed(plain()), over(Over::NotAsked)),
        ("failed", with(plain()), failed(plain()), Outlook::Again { attempts: 1 }),
        (
            "twice",
            with(plain()),
            failed(json!({"failedAttempts": 2})),
            Outlook::Again { attempts: 2 },
        ),
        ("all", with(plain()), failed(json!({"failedAttempts": 3})), over(Over::Exhausted(3))),
        ("in all", with(plain()), failed(json!({"attemptsUsed": 2})), over(Over::Exhausted(3))),
        (
            "fenced",
            with(plain()),
            failed(json!({"reason": "NodeFenced"})),
            Outlook::Again { attempts: 1 },
        ),
        ("never placed", with(plain()), json!({"phase": "Failed"}), over(Over::NeverPlaced)),
        (
            "deadline",
            with(plain()),
            stopped(DEADLINE_EXCEEDED, DEADLINE_EXCEEDED),
            over(Over::Deadline),
        ),
        (
            "failed as its time passed",
            with(plain()),
            stopped(DEADLINE_EXCEEDED, "Error"),
            over(Over::Deadline),
        ),
        ("preempted", with(plain()), stopped(PREEMPTED, PREEMPTED), Outlook::Again { attempts: 0 }),
        (
            "drained",
            with(plain()),
            stopped(NODE_MAINTENANCE, NODE_MAINTENANCE),
            Outlook::Again { attempts: 0 },
        ),
        ("preempted, not asked for", plain(), stopped(PREEMPTED, PREEMPTED), over(Over::NotAsked)),
        (
            "failed while it was preempted",
            with(plain()),
            stopped(PREEMPTED, "Error"),
            Outlook::Again { attempts: 1 },
        ),
        (
            "left its radius",
            radius.clone(),
            stopped(OUT_OF_RANGE, OUT_OF_RANGE),
            Outlook::Again { attempts: 0 },
        ),
        ("failed after it left", radius, stopped(OUT_OF_RANGE, "Error"), over(Over::NotAsked)),
    ] {
        assert_eq!(task(spec, status).outlook(), outlook, "{name}");
    }
    let mut owned = task(with(plain()), failed(plain()));
    let owner = json!([{"apiVersion": "v", "kind": "TaskSet", "name": "s", "uid": "s", "controller": true}]);
    owned.metadata.owner_references = serde_json::from_value(owner).expect("references");
    assert_eq!(owned.outlook(), over(Over::Owned));
    let mut held = task(with(plain()), failed(plain()));
    held.metadata.finalizers = Some(vec!["example.org/see-first".to_owned()]);
    assert_eq!(held.outlook(), over(Over::Kept));
}

/// What happens to a task on one node.
#[derive(Debug, Clone, Copy)]
enum Fate {
    /// So many attempts fail, if it may have so many there.
    Fails(u32),
    /// It is ended for another's sake.
    Ordered,
}

fn fate() -> impl Strategy<Value = Fate> {
    prop_oneof![3 => (1..5_u32).prop_map(Fate::Fails), 1 => Just(Fate::Ordered)]
}

proptest! {
    #[test]
    fn it_never_fails_more_often_than_it_may_and_every_history_ends(
        fates in proptest::collection::vec((fate(), 0..4_u8), 1..60),
        most in 1..12_u32,
        each in 1..5_u32,
        first in 0..40_u64,
        more in 0..400_u64,
    ) {
        prop_assume!(most <= MAX_ATTEMPTS);
        let spec = json!({
            "restartPolicy": "OnFailure",
            "reschedule": {
                "maxAttempts": most, "attemptsPerNode": each,
                "backoff": format!("{first}s"), "maxBackoff": format!("{}s", first + more),
            },
        });
        let mut task = task(spec, Value::Null);
        let (mut now, mut failed, mut nodes) = (0, 0, 0_usize);
        let mut wait_before = 0;
        for (i, (fate, node)) in fates.into_iter().enumerate() {
            now += 10_000;
            let status = task.status.clone().unwrap_or_default();
            let here = task.spec.attempts_here(status.attempts_used).expect("it is asked for");
            prop_assert!(here >= 1 && failed + here <= most.max(failed + 1));
            let uid = format!("u{i}");
            task.metadata.uid = Some(uid.clone());
            match fate {
                Fate::Fails(n) => {
                    let n = n.min(here);
                    failed += n;
                    nodes += 1;
                    fails(&mut task, &format!("n{node}"), n, at(now));
                }
                Fate::Ordered => {
                    fails(&mut task, &format!("n{node}"), 0, at(now));
                    let status = task.status.as_mut().expect("it has one");
                    status.reason = PREEMPTED.to_owned();
                    let stop = json!({"reason": PREEMPTED, "message": "m", "at": at(now).to_string()});
                    status.stop = serde_json::from_value(stop).expect("an order");
                }
            }
            match step(&task, at(now)) {
                Step::Again(next) => {
                    prop_assert!(failed < most);
                    prop_assert_eq!(next.attempts_used, failed);
                    prop_assert!(next.earlier.len() <= EARLIER_LIMIT);
                    let last = next.earlier.last().expect("the one that just ended");
                    prop_assert_eq!(&last.uid, &uid);
                    prop_assert_eq!(next.first_bound_at.as_ref().map(|t| t.0), Some(at(10_000)));
                    let wait = next.not_before.as_ref().map(|t| t.0.duration_since(at(now)).as_secs());
                    match fate {
                        Fate::Ordered => prop_assert_eq!(wait, None),
                        Fate::Fails(_) => {
                            let wait = wait.expect("a failure is waited for");
                            let cap = (first + more) as i64;
                            prop_assert!(wait <= cap);
                            prop_assert!(wait >= wait_before.min(cap), "it never gets shorter");
                            if nodes <= EARLIER_LIMIT {
                                let doubled = (first as i64).saturating_mul(1 << (nodes - 1));
                                prop_assert_eq!(wait, doubled.min(cap));
                            }
                            wait_before = wait;
                        }
                    }
                    task.status = Some(*next);
                }
                Step::Conclude { message, .. } => {
                    prop_assert_eq!(failed, most);
                    let here = format!("n{node}");
                    prop_assert!(message.contains(&here));
                    return Ok(());
                }
                Step::Nothing => prop_assert!(false, "it has failed, and somebody asked for more"),
            }
        }
    }
}
