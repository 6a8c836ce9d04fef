//! Without the right to make control groups: refused, or run without them on the operator's word.

mod common;

use common::agent::Agent;
use common::controller::Controller;
use common::{lives, until};
use muster_api::wire::agent::v1 as proto;
use serde_json::json;

#[test]
fn without_rights_a_quota_is_refused() {
    let controller = Controller::start();
    let _agent = Agent::start_as_nobody(&controller, &[]);
    let state = controller.state().unwrap();
    let enforced = state.conditions.iter().find(|c| c.r#type == "QuotasEnforced").unwrap();
    assert!(!enforced.status && enforced.message.contains("refused"), "{enforced:?}");
    controller.assign(
        "held",
        json!({ "resources": { "cpu": "100m" }, "run": { "process": { "command": ["true"] } } }),
    );
    let end = controller.wait_end("held");
    assert_eq!((end.phase(), end.reason.as_str()), (proto::TaskPhase::Failed, "QuotaNotEnforced"));
    assert!(end.message.contains("--unenforced-quotas"), "{end:?}");
    controller.assign("plain", json!({ "run": { "process": { "command": ["true"] } } }));
    assert_eq!(controller.wait_end("plain").exit_code, Some(0));
}

#[test]
fn without_groups_nothing_of_a_task_is_left_either() {
    let controller = Controller::start();
    let mut agent = Agent::start_as_nobody(&controller, &["--unenforced-quotas"]);
    let file = agent.dir.path().join("tasks/loose/work/pids");
    let script = "trap '' TERM; (setsid sh -c 'trap \"\" TERM; echo $$ >> pids; while :; do sleep 1000; done' &); \
        sh -c 'trap \"\" TERM; echo $$ >> pids; while :; do sleep 1000; done' & while :; do sleep 1000; done";
    controller.assign(
        "loose",
        json!({ "resources": { "cpu": "100m" }, "run": { "process": { "command": ["sh", "-c", script] } } }),
    );
    controller.wait_running("loose");
    let pids: Vec<i32> = until("both", || {
        let text = std::fs::read_to_string(&file).ok()?;
        let pids: Vec<i32> = text.lines().map(|line| line.parse().unwrap()).collect();
        (pids.len() == 2).then_some(pids)
    });
    agent.kill();
    agent.spawn();
    controller.wait_hello(2);
    assert!(pids.iter().all(|pid| lives(*pid)));
    until("usage", || controller.usage("loose").filter(|usage| usage.memory_bytes > 0));
    controller.stop("loose", 200);
    assert_eq!(controller.wait_end("loose").reason, "Stopped");
    assert!(pids.iter().all(|pid| !lives(*pid)));
    // A killed shim loses the status, and still no process.
    controller.assign("lost", json!({ "gracePeriodSeconds": 0, "run": { "process": { "command":
        ["sh", "-c", "(setsid sleep 1000 &); echo $$; trap '' TERM; while :; do sleep 1000; done"] } } }));
    controller.wait_running("lost");
    let pid = agent.main_pid("lost", 1);
    // SAFETY: a signal to a process of this test.
    unsafe { libc::kill(agent.shim_pid("lost", 1), libc::SIGKILL) };
    assert_eq!(controller.wait_end("lost").reason, "ShimLost");
    assert!(!lives(pid));
}

#[test]
fn without_groups_a_task_is_looked_at_too() {
    let controller = Controller::start();
    let agent = Agent::start_as_nobody(&controller, &["--unenforced-quotas"]);
    let check =
        "echo $$ > $MUSTER_RUN_DIR/check; id -u; trap '' TERM; while :; do sleep 0.05; done";
    controller.assign(
        "looked-at",
        json!({
            "run": { "process": { "command": ["sleep", "1000"] } },
            "readiness": { "exec": { "command": ["sh", "-c", "exit $(id -u | cut -c 1)"] },
                "period": "100ms", "timeout": "10s" },
            "liveness": { "exec": { "command": ["sh", "-c", check] }, "timeout": "1h" },
        }),
    );
    controller.wait("looked-at", "answer", |report| report.message.contains("exited with code 6"));
    let file = agent.task_dir("looked-at").join("run/check");
    let check: i32 = until("a check", || std::fs::read_to_string(&file).ok()?.trim().parse().ok());
    controller.stop("looked-at", 600_000);
    assert_eq!(controller.wait_end("looked-at").signal, Some(15));
    assert!(!lives(check));
}
