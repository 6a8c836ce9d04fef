//! Executors under a real agent: real processes and control groups; what the executor says, the test says.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use common::agent::Agent;
use common::controller::Controller;
use common::executor::Executor;
use common::{lives, until};
use muster_api::wire::agent::v1::{self as agent_proto, TaskPhase};
use muster_api::wire::executor::v1 as proto;
use proto::TaskState;
use proto::call::Call as Say;
use proto::event::Event as Heard;
use serde_json::json;

fn assign(controller: &Controller, uid: &str, spec: &serde_json::Value) {
    controller.assign_with(agent_proto::Assignment {
        uid: uid.to_owned(),
        namespace: "lab".to_owned(),
        name: uid.to_owned(),
        spec: serde_json::to_vec(spec).unwrap(),
        lease: Some(agent_proto::LeaseToken {
            node: "robot-1".to_owned(),
            group: "body".to_owned(),
            epoch: 3,
            sequence: vec![],
        }),
        framework: Some(agent_proto::Framework { id: "f-1".to_owned(), name: "crew".to_owned() }),
        ..Default::default()
    });
}

fn assign_executor(controller: &Controller) {
    assign(
        controller,
        "exec",
        &json!({
            "resources": { "cpu": "100m", "memory": "64Mi" },
            "run": { "process": { "command": ["sleep", "1000"] } },
        }),
    );
}

fn assign_work(controller: &Controller, uid: &str) {
    assign(
        controller,
        uid,
        &json!({
            "resources": { "cpu": "200m", "memory": "32Mi" },
            "run": { "executor": { "task": "exec", "data": { "goal": [1, "x"] } } },
        }),
    );
}

/// An executor with two works that run.
fn two_works(controller: &Controller, agent: &Agent) -> Executor {
    assign_work(controller, "w1");
    controller.wait("w1", "waiting", |report| report.reason == "AwaitingExecutor");
    assign_executor(controller);
    let mut executor = Executor::register(agent, "exec", &[]);
    assert_eq!(executor.framework, ("f-1".to_owned(), "crew".to_owned()));
    let launch = executor.launched();
    assert_eq!((launch.task.as_str(), launch.name.as_str()), ("w1", "w1"));
    assert!(launch.data.unwrap().fields.contains_key("goal"));
    let lease = launch.lease.unwrap();
    assert_eq!((lease.node.as_str(), lease.group.as_str(), lease.epoch), ("robot-1", "body", 3));
    assign_work(controller, "w2");
    assert_eq!(executor.launched().task, "w2");
    for work in ["w1", "w2"] {
        executor.update(work, TaskState::Starting);
        executor.update(work, TaskState::Running);
        controller.wait_running(work);
    }
    executor
}

/// Cpu in thousandths of a core and memory in bytes, from the kernel.
fn limits(agent: &Agent) -> (i64, u64) {
    let read = |controller: &str, file: &str| {
        std::fs::read_to_string(agent.group("exec", 1, controller).join(file)).ok()
    };
    if let Some(max) = read("cpu", "cpu.max") {
        let numbers: Vec<i64> = max.split_whitespace().map(|n| n.parse().unwrap()).collect();
        let memory = read("memory", "memory.max").unwrap().trim().parse().unwrap();
        return (numbers[0] * 1_000 / numbers[1], memory);
    }
    let number = |controller: &str, file: &str| -> i64 {
        read(controller, file).unwrap().trim().parse().unwrap()
    };
    let quota = number("cpu", "cpu.cfs_quota_us") * 1_000 / number("cpu", "cpu.cfs_period_us");
    (quota, number("memory", "memory.limit_in_bytes").cast_unsigned())
}

#[test]
fn works_run_end_and_are_ended_and_the_limits_follow() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut executor = two_works(&controller, &agent);
    assert_eq!(limits(&agent), (500, 128 << 20));

    let large = vec![7; 4 << 20];
    controller.message("exec", large.clone());
    let Heard::Message(message) = executor.hear() else { panic!("no message") };
    assert!(message.data == large);
    for data in [message.data, b"second".to_vec().into()] {
        executor.say(Say::Message(proto::Message { data }));
    }
    let heard = until("both", || Some(controller.messages()).filter(|all| all.len() == 2));
    assert!(heard[0].data == large && heard[1].data == "second" && heard[1].executor == "exec");

    executor.update("w1", TaskState::Failed);
    let end = controller.wait_end("w1");
    assert_eq!((end.exit_code, end.message.as_str()), (Some(7), "w1 says so"), "{end:?}");
    until("less room", || (limits(&agent) == (300, 96 << 20)).then_some(()));

    controller.stop("w2", 30_000);
    let Heard::Kill(kill) = executor.hear() else { panic!("no kill") };
    assert_eq!((kill.task.as_str(), kill.grace_period_ms), ("w2", 30_000));
    executor.update("w2", TaskState::Killed);
    let end = controller.wait_end("w2");
    assert_eq!((end.phase(), end.reason.as_str()), (TaskPhase::Failed, "Stopped"), "{end:?}");
    until("its own room", || (limits(&agent) == (100, 64 << 20)).then_some(()));
    assert!(lives(agent.main_pid("exec", 1)));
    assert_eq!(
        controller.executors(),
        [vec![], vec!["exec".to_owned()]],
        "each change is said once"
    );
}

#[test]
fn nothing_waits_behind_messages() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut executor = two_works(&controller, &agent);
    controller.set_stuck_messages(true);
    let large = vec![7; 4 << 20];
    let words = ["first", "second"];
    executor.say(Say::Message(proto::Message { data: words[0].into() }));
    executor.say(Say::Message(proto::Message { data: large.clone().into() }));
    executor.say(Say::Message(proto::Message { data: words[1].into() }));
    executor.update("w1", TaskState::Failed);
    controller.wait_end("w1");
    let beats = controller.beats();
    until("heartbeats", || (controller.beats() > beats + 5).then_some(()));
    controller.message("exec", b"to it".to_vec());
    let told = until("a message", || match executor.hear() {
        Heard::Message(message) => Some(message.data),
        _ => None,
    });
    assert_eq!(told, "to it");
    assert!(controller.messages().len() <= 1, "the first was asked for before");
    controller.set_stuck_messages(false);
    let heard = until("all", || Some(controller.messages()).filter(|all| all.len() == 3));
    assert!(heard[1].data == large);
    assert_eq!([&heard[0].data, &heard[2].data], words);
}

#[test]
fn who_does_not_read_its_acknowledgements_is_not_heard_without_end() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut executor = two_works(&controller, &agent);
    // Of a work that it does not have: it is acknowledged without a look at the disk.
    let many = 400_000;
    let taken = executor.flood("?", many);
    assert!(taken < many, "all were taken, and the answers wait in memory");
    controller.stop("exec", 0);
    controller.wait_end("exec");
}

/// An executor that ends with 0 when `file` is there, and with 3 when it is signalled.
fn assign_watching(controller: &Controller, file: &std::path::Path) {
    let script =
        format!("trap 'exit 3' TERM; while ! [ -e {} ]; do sleep 0.02; done", file.display());
    assign(
        controller,
        "exec",
        &json!({ "run": { "process": { "command": ["sh", "-c", script] } } }),
    );
}

#[test]
fn an_executor_that_must_end_is_asked_and_exits_by_itself() {
    let (controller, dir) = (Controller::start(), tempfile::tempdir().unwrap());
    let agent = Agent::start(&controller);
    let file = dir.path().join("go");
    assign_watching(&controller, &file);
    let mut executor = Executor::register(&agent, "exec", &[]);
    controller.wait_running("exec");
    controller.stop("exec", 600_000);
    let Heard::Shutdown(shutdown) = executor.hear() else { panic!("no shutdown") };
    assert_eq!(shutdown.grace_period_ms, 600_000);
    until("no executors", || {
        controller.executors().last().is_some_and(Vec::is_empty).then_some(())
    });
    std::fs::write(&file, "").unwrap();
    let end = controller.wait_end("exec");
    assert_eq!((end.phase(), end.exit_code), (TaskPhase::Succeeded, Some(0)), "{end:?}");
}

#[test]
fn an_executor_that_is_asked_and_stays_is_signalled() {
    let (controller, dir) = (Controller::start(), tempfile::tempdir().unwrap());
    let agent = Agent::start(&controller);
    assign_watching(&controller, &dir.path().join("never"));
    let mut executor = Executor::register(&agent, "exec", &[]);
    controller.wait_running("exec");
    controller.stop("exec", 20_000);
    assert!(matches!(executor.hear(), Heard::Shutdown(_)));
    let end = controller.wait_end("exec");
    assert_eq!((end.exit_code, end.reason.as_str()), (Some(3), "Stopped"), "{end:?}");
}

#[test]
fn works_outlive_the_agent_and_end_with_their_executor() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    let before = two_works(&controller, &agent);
    let pid = agent.main_pid("exec", 1);
    agent.kill();
    agent.spawn();
    controller.wait_hello(2);
    let mut executor = Executor::register(&agent, "exec", &["w1", "w2"]).after(&before);
    assign_work(&controller, "w3");
    assert_eq!(executor.launched().task, "w3", "no work is handed over twice");
    executor.update("w3", TaskState::Succeeded);
    assert_eq!(controller.wait_end("w3").phase(), TaskPhase::Succeeded);
    assert!(lives(pid) && agent.main_pid("exec", 1) == pid);

    // SAFETY: a signal to a process of this test.
    unsafe { libc::kill(pid, libc::SIGKILL) };
    for work in ["w1", "w2"] {
        let end = controller.wait_end(work);
        assert_eq!((end.phase(), end.reason.as_str()), (TaskPhase::Failed, "ExecutorLost"));
        assert!(!lives(pid), "{work} ended before its executor");
    }
    assert!(executor.is_closed());
    until("no executors", || {
        controller.executors().last().is_some_and(Vec::is_empty).then_some(())
    });
    assign_work(&controller, "late");
    assert_eq!(controller.wait_end("late").reason, "ExecutorLost");
}

#[test]
fn who_does_not_end_its_work_is_ended() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut executor = two_works(&controller, &agent);
    let pid = agent.main_pid("exec", 1);
    controller.stop("w1", 200);
    assert!(matches!(executor.hear(), Heard::Kill(_)));
    for work in ["w1", "w2"] {
        assert_eq!(controller.wait_end(work).reason, "ExecutorLost");
        assert!(!lives(pid), "{work} ended before its executor");
    }
    assert!(controller.wait_end("exec").signal.is_some());
}

#[test]
fn only_who_has_the_token_is_the_executor() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut executor = two_works(&controller, &agent);
    let mut stranger = Executor::dial(&agent, "exec");
    stranger.show(&"0".repeat(32), &[]);
    assert!(stranger.is_closed());
    let mut hasty = Executor::dial(&agent, "exec");
    hasty.say(Say::Message(proto::Message { data: "first".into() }));
    assert!(hasty.is_closed());
    // Neither disturbed it; who has the token takes its place.
    executor.update("w1", TaskState::Running);
    let mut next = Executor::register(&agent, "exec", &["w1", "w2"]).after(&executor);
    assert!(executor.is_closed());
    next.update("w1", TaskState::Succeeded);
    assert_eq!(controller.wait_end("w1").phase(), TaskPhase::Succeeded);
    assert!(controller.messages().is_empty());
}

#[test]
fn a_work_of_which_nothing_was_said_ends_without_contact_too() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    assign_executor(&controller);
    let mut executor = Executor::register(&agent, "exec", &[]);
    let spec = json!({
        "run": { "executor": { "task": "exec", "data": {} } },
        "onDisconnect": { "policy": "Stop", "after": "5s" },
    });
    assign(&controller, "tied", &spec);
    assert_eq!(executor.launched().task, "tied");
    controller.set_away(true);
    assert!(matches!(executor.hear(), Heard::Kill(kill) if kill.task == "tied"));
    executor.update("tied", TaskState::Killed);
    controller.set_away(false);
    assert_eq!(controller.wait_end("tied").reason, "Disconnected");
}
