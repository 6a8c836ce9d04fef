//! Joining, losing and finding the controller.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use common::agent::{Agent, command};
use common::controller::Controller;
use common::{lives, until};
use muster_api::wire::agent::v1 as proto;
use serde_json::json;

fn sh(script: &str) -> serde_json::Value {
    json!({ "run": { "process": { "command": ["sh", "-c", script] } } })
}

fn refused(args: &[&str], dir: &std::path::Path) -> (Option<i32>, String) {
    let args: Vec<String> = args.iter().map(|arg| (*arg).to_owned()).collect();
    let output = command(dir, &args).env_remove("RUST_LOG").output().unwrap();
    (output.status.code(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn joins_are_refused_with_reasons() {
    let controller = Controller::start();
    let dir = tempfile::tempdir().unwrap();
    let url = controller.url();
    let base = ["--name", "r", "--kind", "robot", "--docker-socket", "none", "--join", &url];
    let with = |token: &str| {
        let mut args = base.to_vec();
        args.extend(["--token", token]);
        refused(&args, dir.path())
    };
    let (code, text) = refused(&base, dir.path());
    assert!(code == Some(2) && text.contains("--token is missing"), "{text}");
    let (code, text) = with("nonsense");
    assert!(code == Some(2) && text.contains("not a join token"), "{text}");
    let wrong_ca = format!("muster1.id.secret.{}", "00".repeat(32));
    let (code, text) = with(&wrong_ca);
    assert!(code == Some(3) && text.contains("another hash"), "{text}");
    let expired = controller.token().replace("secret", "old");
    let (code, text) = with(&expired);
    assert!(code == Some(3) && text.contains("the token has expired"), "{text}");
    assert_eq!(controller.joins(), 0);
}

#[test]
fn a_directory_is_of_one_node() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    assert_eq!(agent.terminate(), Some(0));
    let url = controller.url();
    let (code, text) = refused(&["--name", "other", "--join", &url], agent.dir.path());
    assert!(code == Some(2) && text.contains("robot-1"), "{text}");
    // It needs neither token nor name nor address again.
    agent.args = vec!["--docker-socket".to_owned(), "none".to_owned()];
    agent.spawn();
    assert_eq!(controller.wait_hello(2).node, "robot-1");
    assert_eq!(controller.joins(), 1);
}

#[test]
fn the_node_says_what_it_is() {
    let controller = Controller::start();
    let args = [
        "--sr-res",
        "kinect:ImageGen",
        "--ar-res",
        "base:Drive",
        "--label",
        "a=b",
        "--speed",
        "0.5",
    ];
    let mut agent = Agent::start_with(&controller, &args);
    let state = controller.state().unwrap();
    assert_eq!(state.sensors, ["kinect:ImageGen"]);
    assert_eq!(state.actuators, ["base:Drive"]);
    assert_eq!(state.labels["a"], "b");
    let pose = state.pose.unwrap();
    assert_eq!((pose.x, pose.y, pose.map.as_str()), (1.0, 2.0, "map"));
    let enforced = state.conditions.iter().find(|c| c.r#type == "QuotasEnforced").unwrap();
    assert!(enforced.status, "{enforced:?}");
    assert!(state.runtimes.iter().any(|r| r.name == "process" && r.available));
    assert!(state.runtimes.iter().any(|r| r.name == "docker" && !r.available));
    // Started again without a word, it is what it was; what is said then wins, field by field.
    agent.terminate();
    agent.args = vec!["--docker-socket".to_owned(), "none".to_owned()];
    agent.spawn();
    let again = controller.wait_hello(2).state.unwrap();
    assert_eq!((&again.sensors, &again.actuators), (&state.sensors, &state.actuators));
    assert_eq!(again.labels, state.labels);
    assert_eq!((again.pose.unwrap().x, pose.y), (1.0, 2.0));
    agent.terminate();
    agent.args.extend(["--sr-res", "", "--label", "c=d"].map(str::to_owned));
    agent.spawn();
    let third = controller.wait_hello(3).state.unwrap();
    assert_eq!((third.sensors.len(), &third.actuators), (0, &state.actuators));
    assert!(third.labels.contains_key("c") && !third.labels.contains_key("a"));
}

#[test]
fn a_robot_that_moves_says_so() {
    let controller = Controller::start();
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("pose");
    let stand = |x: f64| {
        let new = dir.path().join("new");
        std::fs::write(&new, format!("{x} 2 0.5\n")).unwrap();
        std::fs::rename(&new, &file).unwrap();
    };
    stand(1.0);
    let source = format!("file:{}", file.display());
    let _agent = Agent::start_with(&controller, &["--position", &source, "--map", "lab"]);
    until("its first pose", || {
        let told = controller.poses().pop().or_else(|| controller.state()?.pose);
        told.filter(|p| p.x == 1.0)
    });
    stand(3.0);
    let pose = until("the move", || controller.poses().pop().filter(|p| p.x == 3.0));
    assert_eq!((pose.map.as_str(), pose.source.as_str(), pose.yaw), ("lab", "file", 0.5));
    assert!(pose.localized && pose.stamp.is_some());
    std::fs::remove_file(&file).unwrap();
    // By itself, or with the node's state, whose condition Localized changes too: whichever goes first.
    until("that it is lost", || {
        let alone = controller.poses().pop();
        let with_state = controller.state().and_then(|state| state.pose);
        [alone, with_state].into_iter().flatten().find(|pose| !pose.localized)
    });
}

#[test]
fn everything_goes_on_without_a_controller() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    let go = agent.dir.path().join("go");
    controller.assign("keep", sh("sleep 1000"));
    controller.assign(
        "end",
        sh(&format!("while [ ! -e {} ]; do sleep 0.02; done; exit 9", go.display())),
    );
    controller.wait_running("keep");
    controller.wait_running("end");
    let pid = agent.main_pid("keep", 1);
    controller.set_away(true);
    agent.kill();
    agent.spawn();
    std::fs::write(&go, "").unwrap();
    until("the exit record", || agent.has_exit_record("end", 1).then_some(()));
    controller.set_away(false);
    assert_eq!(controller.wait_end("end").exit_code, Some(9));
    assert!(lives(pid));
    // What a complete set does not name is ended; its end is told, and then it may be forgotten.
    controller.unassign("keep");
    controller.set_away(true);
    controller.set_away(false);
    assert_eq!(controller.wait_end("keep").reason, "Stopped");
    assert!(agent.task_dir("keep").exists());
    controller.release("keep");
    until("the task to go", || (!agent.task_dir("keep").exists()).then_some(()));
    assert!(!lives(pid));
}

#[test]
fn a_task_that_may_not_run_alone_ends_alone() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    let mut spec = sh("sleep 1000");
    spec["onDisconnect"] = json!({ "policy": "Stop", "after": "5s" });
    spec["restartPolicy"] = json!("Always");
    controller.assign("tied", spec.clone());
    controller.assign("free", sh("sleep 1000"));
    controller.wait_running("tied");
    controller.wait_running("free");
    let (tied, free) = (agent.main_pid("tied", 1), agent.main_pid("free", 1));
    // Heartbeats are answered for longer than the task may be alone: it lives.
    let beats = controller.beats();
    until("six seconds of heartbeats", || (controller.beats() > beats + 60).then_some(()));
    assert!(lives(tied));
    // The agent is frozen: only the shim can act.
    // SAFETY: signals to a child of this test.
    unsafe { libc::kill(agent.pid(), libc::SIGSTOP) };
    until("the end by the shim", || (!lives(tied)).then_some(()));
    assert!(lives(free));
    // SAFETY: as above.
    unsafe { libc::kill(agent.pid(), libc::SIGCONT) };
    let end = controller.wait_end("tied");
    assert_eq!((end.reason.as_str(), end.phase()), ("Disconnected", proto::TaskPhase::Failed));
    // With the agent dead as well, and after its return nothing starts without contact.
    controller.assign("tied2", spec);
    controller.wait_running("tied2");
    let tied = agent.main_pid("tied2", 1);
    controller.set_away(true);
    agent.kill();
    until("the end by the shim", || (!lives(tied)).then_some(()));
    agent.spawn();
    controller.set_away(false);
    assert_eq!(controller.wait_end("tied2").reason, "Disconnected");
}

#[test]
fn an_unanswered_report_is_said_again() {
    let controller = Controller::start();
    let _agent = Agent::start(&controller);
    controller.set_mute(true);
    controller.assign("once", sh("exit 0"));
    let end = controller.wait_end("once");
    until("the same report again", || {
        let same = controller.reports("once").into_iter().filter(|r| r.sequence == end.sequence);
        (same.count() >= 2).then_some(())
    });
}

#[test]
fn a_task_ordered_to_stop_before_it_came_never_starts() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    controller.assign_with(proto::Assignment {
        uid: "late".to_owned(),
        spec: serde_json::to_vec(&sh("touch /dev/null")).unwrap(),
        stop: Some(proto::Stop { grace_period_ms: 0, reason: "Deleted".to_owned() }),
        ..proto::Assignment::default()
    });
    let end = controller.wait_end("late");
    assert_eq!((end.attempt, end.reason.as_str()), (0, "Stopped"));
    assert!(!agent.task_dir("late").join("attempts").exists());
}

#[test]
fn an_assignment_that_cannot_be_read_is_reported_once_as_failed() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    controller.assign("new", json!({ "run": { "wasm": { "module": "drive" } } }));
    let end = controller.wait_end("new");
    assert_eq!(
        (end.phase(), end.reason.as_str(), end.attempt),
        (proto::TaskPhase::Failed, "AssignmentUnreadable", 0)
    );
    assert!(end.message.contains("wasm") && end.finished_at.is_some(), "{end:?}");
    // It is in the journal: another life of the agent says the same, and a release ends it.
    agent.kill();
    agent.spawn();
    let again = controller.wait("new", "the same again", |again| again.sequence > end.sequence);
    assert_eq!(proto::TaskReport { sequence: end.sequence, ..again }, end);
    controller.release("new");
    until("the task to go", || (!agent.task_dir("new").exists()).then_some(()));
}
