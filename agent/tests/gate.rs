//! The gate before a robot's driver: real processes, a driver that writes down what it hears, and holders whose words are the
//! test's.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::agent::Agent;
use common::controller::Controller;
use common::gate::{self, Driver, Holder};
use common::{lives, until};
use muster_api::wire::agent::v1 as agent_proto;
use muster_api::wire::gate::v1::Verdict;
use serde_json::json;

/// Silence does not stop the robot before the test has said what it wants to say.
const PATIENT: &str = "  ladder: [{after: 5m, action: Stop}]\n";

fn assign(controller: &Controller, uid: &str, epoch: Option<u64>) {
    controller.assign_with(agent_proto::Assignment {
        uid: uid.to_owned(),
        namespace: "lab".to_owned(),
        name: uid.to_owned(),
        spec: serde_json::to_vec(&json!({
            "run": { "process": { "command": ["sleep", "1000"] } },
            "gracePeriodSeconds": 1,
        }))
        .unwrap(),
        lease: epoch.map(|epoch| agent_proto::LeaseToken {
            node: "robot-1".to_owned(),
            group: "body".to_owned(),
            epoch,
            sequence: vec![],
        }),
        ..Default::default()
    });
    controller.wait_running(uid);
}

fn start(controller: &Controller, driver: &Driver) -> Agent {
    let config = driver.config().display().to_string();
    Agent::start_with(controller, &["--config", &config])
}

/// A robot that `a` holds with epoch 6, beside `b` that holds nothing.
fn robot(controller: &Controller, driver: &Driver) -> Agent {
    let agent = start(controller, driver);
    assign(controller, "a", Some(6));
    assign(controller, "b", None);
    driver.wait("stop");
    agent
}

#[test]
fn only_the_holder_drives_and_is_told_who_it_is() {
    let (controller, driver) = (Controller::start(), Driver::new(PATIENT));
    let agent = robot(&controller, &driver);
    let mut a = Holder::register(&agent, "a");
    let mut b = Holder::register(&agent, "b");
    assert_eq!((a.task.as_str(), b.task.as_str()), ("a", "b"));
    assert_eq!(a.verdict("6", "go 1"), Verdict::Ok);
    // Of commands that wait for the driver only the newest is kept.
    driver.wait("go 1");
    let refused = b.command("6", "go wrong").unwrap();
    assert_eq!(refused.verdict(), Verdict::NotHolder);
    let holder = refused.holder.unwrap();
    assert_eq!((holder.task.as_str(), holder.epoch), ("a", 6));
    assert_eq!(a.verdict("5", "go wrong"), Verdict::Older);
    assert_eq!(b.verdict("7", "go wrong"), Verdict::Unknown);
    // Delegation, and taking back.
    assert_eq!(a.delegate("6,1", "b"), Verdict::Ok);
    assert_eq!(b.verdict("6,1", "go 2"), Verdict::Ok);
    driver.wait("go 2");
    assert_eq!(a.verdict("6,0", "go wrong"), Verdict::Older);
    assert_eq!(a.verdict("6,2", "go 3"), Verdict::Ok);
    assert_eq!(b.verdict("6,1", "go wrong"), Verdict::Older);
    // Whoever is nobody is put out.
    let nobody = gate::frame(muster_api::wire::gate::v1::call::Call::Register(
        muster_api::wire::gate::v1::Register { token: "guess".to_owned() },
    ));
    assert!(Holder::show(&gate::socket(&agent), &nobody).is_none());
    driver.wait("go 3");
    let heard: Vec<String> = driver.heard().into_iter().filter(|word| word != "stop").collect();
    assert_eq!(heard, ["go 1", "go 2", "go 3"]);
}

#[test]
fn a_holder_that_is_killed_leaves_a_robot_that_stands() {
    let (controller, driver) = (Controller::start(), Driver::new(PATIENT));
    let agent = robot(&controller, &driver);
    let words = [gate::register(&agent, "a"), gate::frame(gate::command(1, "6", "go"))].concat();
    let program = "import socket, sys, time\ns = socket.socket(socket.AF_UNIX)\ns.connect(sys.argv[1])\ns.sendall(sys.stdin.buffer.read())\ntime.sleep(1000)";
    let mut child = Command::new("python3")
        .args(["-c", program])
        .arg(gate::socket(&agent))
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    std::io::Write::write_all(&mut child.stdin.take().unwrap(), &words).unwrap();
    driver.wait("go");
    child.kill().unwrap();
    child.wait().unwrap();
    driver.wait("stop");
}

#[test]
fn a_holder_that_is_silent_is_stopped() {
    let (controller, driver) = (Controller::start(), Driver::new(""));
    let agent = robot(&controller, &driver);
    let mut a = Holder::register(&agent, "a");
    let stops = driver.heard().len();
    assert_eq!(a.verdict("6", "go"), Verdict::Ok);
    until("the stop", || (driver.heard().len() >= stops + 2).then_some(()));
    assert_eq!(driver.heard()[stops..], ["go", "stop"], "the command is not repeated");
    assert_eq!(a.verdict("6", "on"), Verdict::Ok, "it is still the holder");
}

#[test]
fn the_task_of_a_holder_that_stays_silent_is_ended() {
    let ladder = "  ladder: [{after: 100ms, action: Stop}, {after: 300ms, action: Release}]\n";
    let (controller, driver) = (Controller::start(), Driver::new(ladder));
    let agent = robot(&controller, &driver);
    let mut a = Holder::register(&agent, "a");
    assert_eq!(a.verdict("6", "go"), Verdict::Ok);
    let end = controller.wait_end("a");
    assert!(end.message.contains("was silent for too long"), "{end:?}");
    assert_eq!(driver.heard().last().map(String::as_str), Some("stop"));
    assert!(controller.reports("b").iter().all(|report| report.message.is_empty()));
}

#[test]
fn a_stop_does_not_wait_for_an_agent_that_cannot_speak() {
    let (controller, driver) = (Controller::start(), Driver::new(PATIENT));
    let agent = robot(&controller, &driver);
    let mut a = Holder::register(&agent, "a");
    assert_eq!(a.verdict("6", "go"), Verdict::Ok);
    driver.wait("go");
    controller.assign(
        "talker",
        json!({"run": {"process": {"command": ["sh", "-c", "yes muster | head -c 33554432; sleep 1000"]}}}),
    );
    controller.wait_running("talker");
    controller.set_stuck(true);
    let said = controller.beats();
    controller.ask_logs(agent_proto::LogRequest {
        id: 1,
        uid: "talker".to_owned(),
        follow: true,
        ..Default::default()
    });
    // What it would say next waits for room that there is not: a session that takes orders in turn would not take this.
    let (mut before, mut since) = (0, Instant::now());
    until("it to be stuck", || {
        let now = agent.bytes_read();
        if now != before {
            (before, since) = (now, Instant::now());
        }
        (since.elapsed() >= Duration::from_millis(250)).then_some(())
    });
    controller.order_estop(1, 0);
    driver.wait("stop");
    assert_eq!(a.verdict("6", "go wrong"), Verdict::Stopped);
    assert!(controller.beats() <= said + 1, "it was not heard meanwhile");
    assert_eq!(controller.hellos().len(), 1, "in the same session");
    controller.set_stuck(false);
    until("its word", || (controller.state()?.estop?.tier == 1).then_some(()));
}

#[test]
fn the_robot_stands_without_its_agent_and_goes_on_with_the_next() {
    let (controller, driver) = (Controller::start(), Driver::new(PATIENT));
    let mut agent = robot(&controller, &driver);
    let (gate, pid) = (agent.gate_pid(), agent.main_pid("a", 1));
    let mut a = Holder::register(&agent, "a");
    assert_eq!(a.verdict("6", "go 1"), Verdict::Ok);
    driver.wait("go 1");
    agent.kill();
    driver.wait("stop");
    assert_eq!(a.verdict("6", "go wrong"), Verdict::Unknown);
    agent.spawn();
    until("the gate to hear of the grant", || {
        (a.verdict("6", "go 2") == Verdict::Ok).then_some(())
    });
    driver.wait("go 2");
    assert_eq!(agent.gate_pid(), gate, "it outlives the agent");
    controller.wait_hello(2);
    // One that goes in order is waited for: nothing stops.
    let before = driver.heard();
    agent.terminate();
    assert_eq!(a.verdict("6", "go 3"), Verdict::Ok);
    agent.spawn();
    controller.wait_hello(3);
    assert_eq!(a.verdict("6", "go 4"), Verdict::Ok);
    driver.wait("go 4");
    assert_eq!(driver.heard()[before.len()..], ["go 3", "go 4"]);
    assert!(lives(pid));
}

#[test]
fn a_gate_that_is_killed_begins_with_a_stop() {
    let (controller, driver) = (Controller::start(), Driver::new(PATIENT));
    let agent = robot(&controller, &driver);
    let mut a = Holder::register(&agent, "a");
    assert_eq!(a.verdict("6,3", "go"), Verdict::Ok);
    driver.wait("go");
    let gate = agent.gate_pid();
    // SAFETY: a signal to a process that this test's agent started.
    unsafe { libc::kill(gate, libc::SIGKILL) };
    driver.wait("stop");
    until("another gate", || (agent.gate_pid() != gate).then_some(()));
    assert!(a.command("6,3", "go wrong").is_none(), "its connection is gone");
    let mut a = Holder::register(&agent, "a");
    until("the grant", || (a.verdict("6,2", "go wrong") == Verdict::Older).then_some(()));
    assert_eq!(a.verdict("6,3", "go 2"), Verdict::Ok);
    assert!(!driver.heard().contains(&"go wrong".to_owned()), "{:?}", driver.heard());
}

#[test]
fn another_holder_has_the_robot_when_the_first_is_gone() {
    let (controller, driver) = (Controller::start(), Driver::new(PATIENT));
    let agent = robot(&controller, &driver);
    let mut a = Holder::register(&agent, "a");
    assert_eq!(a.verdict("6", "go 1"), Verdict::Ok);
    driver.wait("go 1");
    controller.stop("a", 0);
    controller.wait_end("a");
    driver.wait("stop");
    assert!(a.command("6", "go wrong").is_none(), "it was put out with its task");
    assign(&controller, "c", Some(7));
    let mut c = Holder::register(&agent, "c");
    assert_eq!(c.verdict("6", "go wrong"), Verdict::Older);
    assert_eq!(c.verdict("7", "go 2"), Verdict::Ok);
    driver.wait("go 2");
    assert!(!driver.heard().contains(&"go wrong".to_owned()), "{:?}", driver.heard());
}

#[test]
fn a_button_stops_the_robot_until_a_person_releases_it() {
    let controller = Controller::start();
    let driver = Driver::new("");
    let button = driver.dir.path().join("button");
    driver.settings(&format!("{PATIENT}  estop: [{{name: button, file: {}}}]\n", button.display()));
    let mut agent = robot(&controller, &driver);
    let mut a = Holder::register(&agent, "a");
    assert_eq!(a.verdict("6", "go 1"), Verdict::Ok);
    driver.wait("go 1");
    std::fs::write(&button, "settle\n").unwrap();
    driver.wait("stop");
    assert_eq!(a.verdict("6", "go wrong"), Verdict::Stopped);
    std::fs::remove_file(&button).unwrap();
    // It is the same for another gate and another agent.
    // SAFETY: a signal to a process that this test's agent started.
    unsafe { libc::kill(agent.gate_pid(), libc::SIGKILL) };
    agent.kill();
    agent.spawn();
    let mut a = Holder::register(&agent, "a");
    assert_eq!(a.verdict("6", "go wrong"), Verdict::Stopped);
    let told = until("the stop's number", || {
        let state = controller.state()?.estop?;
        (state.tier > 0).then_some(state)
    });
    assert_eq!(told.demands[0].source, "button on the robot");
    controller.order_estop(0, told.number);
    until("the release", || (a.verdict("6", "go 2") == Verdict::Ok).then_some(()));
    controller.order_estop(2, told.number);
    // Without power it may not live to write down its stop.
    until("its power is cut", || {
        let state = controller.state()?;
        let cut = |c: &agent_proto::Condition| {
            c.r#type == "ActuatorsFenced" && !c.status && c.message.contains("its power is cut")
        };
        state.conditions.iter().any(cut).then_some(())
    });
    assert_eq!(a.verdict("6", "go wrong"), Verdict::Stopped);
    assert!(!driver.heard().contains(&"go wrong".to_owned()), "{:?}", driver.heard());
}

#[test]
fn a_gate_of_another_set_up_is_replaced() {
    let (controller, driver) = (Controller::start(), Driver::new(PATIENT));
    let mut agent = robot(&controller, &driver);
    let gate = agent.gate_pid();
    agent.kill();
    driver.settings("  ladder: [{after: 4m, action: Stop}]\n");
    agent.spawn();
    until("another gate", || (agent.gate_pid() != gate && !lives(gate)).then_some(()));
    let mut a = Holder::register(&agent, "a");
    until("the grant", || (a.verdict("6", "go") == Verdict::Ok).then_some(()));
    driver.wait("go");
    agent.kill();
    std::fs::write(driver.config(), "arRes: base:Drive\n").unwrap();
    let gate = agent.gate_pid();
    agent.spawn();
    until("the gate's end", || (!lives(gate)).then_some(()));
    assert_eq!(driver.heard().last().map(String::as_str), Some("stop"));
}

#[test]
fn the_controllers_stop_stands_when_the_agent_is_started_again() {
    let (controller, driver) = (Controller::start(), Driver::new(PATIENT));
    let mut agent = robot(&controller, &driver);
    let mut a = Holder::register(&agent, "a");
    controller.order_estop(1, 0);
    until("the stop", || (a.verdict("6", "go") == Verdict::Stopped).then_some(()));
    controller.set_away(true);
    agent.kill();
    agent.spawn();
    // This life of the agent says what it wants before it hears of the stop.
    let hellos = controller.hellos().len();
    controller.set_away(false);
    until("its hello", || {
        assert_eq!(a.verdict("6", "go wrong"), Verdict::Stopped);
        (controller.hellos().len() > hellos).then_some(())
    });
    assert_eq!(a.verdict("6", "go wrong"), Verdict::Stopped);
    assert!(!driver.heard().contains(&"go wrong".to_owned()), "{:?}", driver.heard());
    controller.order_estop(0, 0);
    until("the release", || (a.verdict("6", "go on") == Verdict::Ok).then_some(()));
}
