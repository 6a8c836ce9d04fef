//! Where a field has Kubernetes' name it means what it means there: tables of what the kubelet does against what the agent's
//! core decides. Where muster means something else, its row says why. Thresholds of probes have their table in
//! `probe/tests.rs`.

#[path = "../../../api/tests/table/mod.rs"]
mod table;

use muster_agent_core::desired::{Desired, RestartPolicy, StopOrder};
use muster_agent_core::observed::{End, Exit, Loss, Started};
use muster_agent_core::report::Phase;
use muster_agent_core::restart::{delay_ms, failures_after};
use muster_agent_core::time::{Boot, Now, Wall};
use muster_agent_core::workload::{
    Context, Effect, Event, Failure, Fetch, Outcome, Response, STOP_AGAIN_MS, Workload,
};
use muster_api::id::TaskUid;
use table::{Differs, Muster, Row, Same, hold};

use RestartPolicy::{Always, Never, OnFailure};

fn context(ms: u64) -> Context {
    let now = Now { boot: Boot(ms), wall: Wall(ms.cast_signed()) };
    Context { now, contact: Some(now.boot) }
}

/// A task whose first attempt runs since 0.
fn running(restart: RestartPolicy) -> Workload {
    let desired = Desired { restart, ..Desired::once(10_000) };
    let (mut task, _) = Workload::assigned(TaskUid::new("t"), desired, Fetch::Nothing, context(0));
    let started = Outcome::Launched(Started { at: Wall(0) });
    let _ = task.handle(Event::Attempt(1, started), context(0));
    assert_eq!(task.report.content.phase, Phase::Running);
    task
}

fn exit(end: End, ran_ms: u64) -> Exit {
    Exit {
        end,
        oom_killed: false,
        disconnected: false,
        started_at: Some(Wall(0)),
        finished_at: Wall(ran_ms.cast_signed()),
    }
}

fn ends(task: &mut Workload, exit: Exit) -> Response {
    let at = exit.finished_at.0.cast_unsigned();
    task.handle(Event::Attempt(1, Outcome::Exited(exit)), context(at))
}

/// What is left of an attempt that ended.
fn left(task: &Workload) -> &'static str {
    match task.report.content.phase {
        Phase::Succeeded => "Succeeded",
        Phase::Failed => "Failed",
        Phase::Starting => "runs again",
        Phase::Running | Phase::Stopping => "runs",
    }
}

/// What becomes of a task whose program ended: the Pod's phase, or another attempt.
#[test]
fn restart_policies() {
    let oom = Exit { oom_killed: true, ..exit(End::Signaled(9), 5_000) };
    // The kernel killed a child, and the program went on without it.
    let child = Exit { oom_killed: true, ..exit(End::Exited(0), 5_000) };
    let unstarted = Exit {
        started_at: None,
        ..exit(End::NotStarted { message: "no such file".to_owned() }, 0)
    };
    let with = |end| exit(end, 5_000);
    let (again, good, bad) = ("runs again", "Succeeded", "Failed");
    let rows: &[Row<(RestartPolicy, Exit), &str>] = &[
        ((Never, with(End::Exited(0))), good, Same),
        ((Never, with(End::Exited(3))), bad, Same),
        ((Never, with(End::Signaled(15))), bad, Same),
        ((Never, oom.clone()), bad, Same),
        ((Never, child.clone()), good, Same),
        ((Never, unstarted.clone()), bad, Same),
        ((Never, with(End::Lost(Loss::Reboot))), bad, Same),
        ((OnFailure, with(End::Exited(0))), good, Same),
        ((OnFailure, with(End::Exited(3))), again, Same),
        ((OnFailure, with(End::Signaled(15))), again, Same),
        ((OnFailure, oom.clone()), again, Same),
        ((OnFailure, child), good, Same),
        ((OnFailure, unstarted.clone()), again, Same),
        ((OnFailure, with(End::Lost(Loss::Reboot))), again, Same),
        ((Always, with(End::Exited(0))), again, Same),
        ((Always, with(End::Exited(3))), again, Same),
        ((Always, with(End::Signaled(15))), again, Same),
        ((Always, oom), again, Same),
        ((Always, unstarted), again, Same),
        ((Always, with(End::Lost(Loss::Reboot))), again, Same),
        (
            (Always, Exit { disconnected: true, ..with(End::Signaled(15)) }),
            again, // A kubelet without its API server goes on.
            Differs(
                bad,
                "its actuators may be another's by now: the controller alone may start it again",
            ),
        ),
    ];
    hold(rows, |(policy, exit)| {
        let mut task = running(policy);
        let _ = ends(&mut task, exit);
        left(&task)
    });
}

/// What is told of an attempt that ended: reason and exit code of a container's `terminated`.
#[test]
fn reasons_and_exit_codes() {
    let oom = Exit { oom_killed: true, ..exit(End::Signaled(9), 1) };
    let unstarted = exit(End::NotStarted { message: "no such file".to_owned() }, 0);
    let rows: &[Row<Exit, (&str, Option<i32>)>] = &[
        (exit(End::Exited(0), 1), ("Completed", Some(0)), Same),
        (exit(End::Exited(3), 1), ("Error", Some(3)), Same),
        (exit(End::Signaled(15), 1), ("Error", Some(143)), Same),
        (oom, ("OOMKilled", Some(137)), Same),
        (
            unstarted,
            ("StartError", Some(128)),
            Differs(("StartError", None), "there was no program that could have had a code"),
        ),
    ];
    hold(rows, |exit| {
        let mut task = running(Never);
        let _ = ends(&mut task, exit);
        let content = &task.report.content;
        (&*content.reason.to_string().leak(), content.exit_code)
    });
}

const SHORT: u64 = 2_000;
const MINUTE: u64 = 60_000;

/// The delays before the attempts that follow runs of these lengths (ms) and exit codes, seconds.
///
/// Kubernetes: 10 s, twice as much each time, 5 min at most; 10 min of running begin anew; the code does not matter.
/// muster: the same from 1 s on, as Kubernetes itself has it with `ReduceDefaultCrashLoopBackOffDecay`.
#[test]
fn back_off() {
    type Delays = &'static [u64];
    const BASE: &str = "the first delay is 1 s: most first failures are a race at start-up, and a robot stands still meanwhile";
    let same_curve = |delays: Delays| -> Muster<Delays> { Differs(delays, BASE) };
    let rows: &[Row<&[(u64, i32)], Delays>] = &[
        (&[(SHORT, 1); 1], &[10], same_curve(&[1])),
        (&[(SHORT, 1); 4], &[10, 20, 40, 80], same_curve(&[1, 2, 4, 8])),
        (
            &[(SHORT, 1); 11],
            &[10, 20, 40, 80, 160, 300, 300, 300, 300, 300, 300],
            same_curve(&[1, 2, 4, 8, 16, 32, 64, 128, 256, 300, 300]),
        ),
        // An end with 0 is an end (restartPolicy Always).
        (&[(SHORT, 0); 3], &[10, 20, 40], same_curve(&[1, 2, 4])),
        // Ten minutes make good, less does not.
        (&[(SHORT, 1), (SHORT, 1), (9 * MINUTE, 1)], &[10, 20, 40], same_curve(&[1, 2, 4])),
        (&[(SHORT, 1), (SHORT, 1), (10 * MINUTE, 1)], &[10, 20, 10], same_curve(&[1, 2, 1])),
        (
            &[(SHORT, 1), (SHORT, 1), (10 * MINUTE, 0), (SHORT, 1)],
            &[10, 20, 10, 20],
            same_curve(&[1, 2, 1, 2]),
        ),
    ];
    hold(rows, |runs| {
        let delays = runs.iter().scan(0, |failures, (ran_ms, code)| {
            *failures = failures_after(*failures, &exit(End::Exited(*code), *ran_ms));
            Some(delay_ms(*failures) / 1_000)
        });
        &*delays.collect::<Vec<_>>().leak()
    });
}

/// The task itself keeps to it: nothing starts before its time.
#[test]
fn nothing_starts_before_its_back_off_is_over() {
    let mut task = running(Always);
    let response = ends(&mut task, exit(End::Exited(1), SHORT));
    assert!(response.effects.contains(&Effect::WakeAt(Boot(SHORT + 1_000))), "{response:?}");
    assert_eq!(task.report.content.reason.to_string(), "BackOff");
    let early = task.handle(Event::Tick, context(SHORT + 999));
    assert!(!early.effects.contains(&Effect::Launch(2)), "{early:?}");
    let due = task.handle(Event::Tick, context(SHORT + 1_000));
    assert!(due.effects.contains(&Effect::Launch(2)), "{due:?}");
}

fn order(task: &mut Workload, grace_ms: Option<u64>) -> Option<u64> {
    let stop = grace_ms.map(|grace_ms| StopOrder { grace_ms, reason: "Deleted".to_owned() });
    let desired = Desired { stop, ..task.desired.clone() };
    let response = task.handle(Event::Assigned(desired), context(SHORT));
    response.effects.iter().find_map(|effect| match effect {
        Effect::Stop { grace_ms, .. } => Some(*grace_ms),
        _ => None,
    })
}

/// `terminationGracePeriodSeconds` on the node: the graces (ms) of orders to end that come one after the other, and those
/// that its processes are told.
#[test]
fn grace_gets_shorter_never_longer() {
    type Told = &'static [Option<u64>];
    let rows: &[Row<&[Option<u64>], Told>] = &[
        (&[Some(10_000)], &[Some(10_000)], Same),
        (&[Some(10_000), Some(5_000)], &[Some(10_000), Some(5_000)], Same),
        (&[Some(10_000), Some(10_000)], &[Some(10_000), None], Same),
        (&[Some(10_000), Some(60_000)], &[Some(10_000), None], Same),
        // Once told, it is not taken back.
        (&[Some(10_000), None], &[Some(10_000), None], Same),
        (
            &[Some(0)],
            &[Some(2_000)], // The kubelet gives two seconds at least.
            Differs(&[Some(0)], "0 means now: somebody stands before the robot"),
        ),
    ];
    hold(rows, |orders| {
        let mut task = running(Never);
        let told = orders.iter().map(|grace| order(&mut task, *grace));
        &*told.collect::<Vec<_>>().leak()
    });
}

/// The same orders, and the grace (ms) that its processes are told when the last one has not ended them and is repeated: a
/// later delete may only shorten what is under way (`DeletionGracePeriodSeconds`).
#[test]
fn a_repeated_order_has_the_shortest_grace() {
    let rows: &[Row<&[Option<u64>], u64>] = &[
        (&[Some(10_000)], 10_000, Same),
        (&[Some(10_000), Some(60_000)], 10_000, Same),
        (&[Some(10_000), Some(5_000), Some(7_000)], 5_000, Same),
        (&[Some(60_000), Some(10_000), None], 10_000, Same),
        (&[Some(5_000), Some(0), Some(60_000)], 0, Same),
    ];
    hold(rows, |orders| {
        let mut task = running(Never);
        for grace in orders.iter() {
            let _ = order(&mut task, *grace);
        }
        let repeated = task.handle(Event::Tick, context(SHORT + MINUTE + STOP_AGAIN_MS));
        let grace = |effect: &Effect| match effect {
            Effect::Stop { grace_ms, .. } => Some(*grace_ms),
            _ => None,
        };
        repeated.effects.iter().find_map(grace).expect("it is told again")
    });
}

/// What becomes of a task that was ordered to end: nothing starts again, and the last exit is its phase.
#[test]
fn what_is_deleted_does_not_start_again() {
    let rows: &[Row<(RestartPolicy, End), &str>] = &[
        ((Always, End::Exited(0)), "Succeeded", Same),
        ((Always, End::Signaled(15)), "Failed", Same),
        ((OnFailure, End::Exited(1)), "Failed", Same),
        ((Never, End::Signaled(9)), "Failed", Same),
    ];
    hold(rows, |(policy, end)| {
        let mut task = running(policy);
        assert_eq!(order(&mut task, Some(10_000)), Some(10_000));
        let _ = ends(&mut task, exit(end, SHORT + 1_000));
        left(&task)
    });
    // In its back-off, too.
    let mut task = running(Always);
    let _ = ends(&mut task, exit(End::Exited(1), SHORT));
    assert_eq!(order(&mut task, Some(10_000)), None, "nothing runs");
    assert_eq!(left(&task), "Failed");
    let late = task.handle(Event::Tick, context(MINUTE));
    assert!(!late.effects.iter().any(|effect| matches!(effect, Effect::Launch(_))), "{late:?}");
}

/// How many attempts a task that always fails has on its node, when so many may fail there: a Job's `backoffLimit` is one
/// less, counts restarts of its Pod's containers under OnFailure, and leaves a start that cannot be made waiting for ever.
#[test]
fn attempts_on_one_node() {
    let failing = |cannot_start: bool| {
        move |(restart, limit): (RestartPolicy, Option<u32>)| {
            let desired = Desired { restart, attempts: limit, ..Desired::once(0) };
            let (mut task, _) =
                Workload::assigned(TaskUid::new("t"), desired, Fetch::Missing, context(0));
            for round in 1..=9 {
                let attempt = task.attempt;
                let event = if cannot_start {
                    let failure = Failure {
                        reason: "ImagePullFailed".to_owned(),
                        message: "no such image".to_owned(),
                        retry: true,
                    };
                    Outcome::LaunchFailed(failure)
                } else {
                    let started = Outcome::Launched(Started { at: Wall(0) });
                    let _ = task.handle(Event::Attempt(attempt, started), context(0));
                    Outcome::Exited(exit(End::Exited(3), 1))
                };
                let _ = task.handle(Event::Attempt(attempt, event), context(1));
                if task.report.content.phase == Phase::Failed {
                    assert_eq!(task.report.content.failed_attempts, round);
                    return Some(round);
                }
                let _ = task.handle(Event::Tick, context(1_000_000 * u64::from(round)));
            }
            None
        }
    };
    type Attempts = Row<(RestartPolicy, Option<u32>), Option<u32>>;
    let rows: &[Attempts] = &[
        ((Never, None), Some(1), Same),
        ((Never, Some(3)), Some(1), Same),
        ((OnFailure, None), None, Same),
        ((OnFailure, Some(1)), Some(1), Same),
        ((OnFailure, Some(4)), Some(4), Same),
    ];
    hold(rows, failing(false));
    let other = "another node may have the image, and somebody asked for it to be tried";
    let rows: &[Attempts] = &[
        ((Never, None), None, Same),
        ((Never, Some(1)), None, Differs(Some(1), other)),
        ((OnFailure, None), None, Same),
        ((OnFailure, Some(4)), None, Differs(Some(4), other)),
    ];
    hold(rows, failing(true));
}

/// An attempt that was ended for another task, or by a reboot, is none that failed.
#[test]
fn what_is_no_failure_uses_up_no_attempt() {
    let desired = Desired { attempts: Some(1), restart: OnFailure, ..Desired::once(0) };
    let (mut task, _) = Workload::assigned(TaskUid::new("t"), desired, Fetch::Nothing, context(0));
    for attempt in 1..4 {
        let started = Outcome::Launched(Started { at: Wall(0) });
        let _ = task.handle(Event::Attempt(attempt, started), context(0));
        let reboot = Outcome::Exited(exit(End::Lost(Loss::Reboot), 1));
        let _ = task.handle(Event::Attempt(attempt, reboot), context(1));
        assert_eq!((left(&task), task.attempt), ("runs again", attempt + 1));
    }
    let started = Outcome::Launched(Started { at: Wall(0) });
    let _ = task.handle(Event::Attempt(4, started), context(0));
    let _ = task.handle(Event::Attempt(4, Outcome::Exited(exit(End::Exited(1), 1))), context(1));
    assert_eq!((left(&task), task.report.content.failed_attempts), ("Failed", 1));
}
