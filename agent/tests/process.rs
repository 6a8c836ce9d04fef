//! Process tasks under a real agent: real programs, real control groups. Needs root and cgroups.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use common::agent::Agent;
use common::controller::Controller;
use common::{lives, start_time, until};
use muster_api::wire::agent::v1 as proto;
use serde_json::json;

fn sh(script: &str) -> serde_json::Value {
    json!({ "run": { "process": { "command": ["sh", "-c", script] } } })
}

#[test]
fn a_program_runs_and_its_exit_code_is_reported() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    controller.assign("ok", sh("exit 0"));
    controller.assign("bad", sh("exit 7"));
    let ok = controller.wait_end("ok");
    assert_eq!(
        (ok.phase(), ok.exit_code, ok.reason.as_str()),
        (proto::TaskPhase::Succeeded, Some(0), "Completed")
    );
    let bad = controller.wait_end("bad");
    assert_eq!(
        (bad.phase(), bad.exit_code, bad.reason.as_str()),
        (proto::TaskPhase::Failed, Some(7), "Error")
    );
    assert!(bad.started_at.is_some() && bad.finished_at.is_some() && bad.attempt == 1);
    controller.release("bad");
    until("the task's files to go", || (!agent.task_dir("bad").exists()).then_some(()));
}

/// Processes of a group, from the kernel.
fn members(agent: &Agent, uid: &str) -> Vec<i32> {
    let procs = agent.group(uid, 1, "pids").join("cgroup.procs");
    let text = std::fs::read_to_string(procs).unwrap_or_default();
    text.lines().map(|line| line.parse().unwrap()).collect()
}

#[test]
fn a_program_that_is_not_there_says_so() {
    let controller = Controller::start();
    let _agent = Agent::start(&controller);
    controller.assign("none", json!({ "run": { "process": { "command": ["/no/such/program"] } } }));
    let end = controller.wait_end("none");
    assert_eq!((end.reason.as_str(), end.exit_code), ("StartError", None));
    assert!(
        end.message.contains("/no/such/program") && end.message.contains("No such file"),
        "{end:?}"
    );
    controller.assign(
        "dir",
        json!({ "run": { "process": { "command": ["true"], "workingDir": "/no/such/dir" } } }),
    );
    let end = controller.wait_end("dir");
    assert!(end.message.contains("/no/such/dir"), "{end:?}");
    controller.assign(
        "user",
        json!({ "run": { "process": { "command": ["true"], "user": "nobody-such" } } }),
    );
    let end = controller.wait_end("user");
    assert!(end.message.contains("nobody-such"), "{end:?}");
}

#[test]
fn environment_directory_and_user() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let script = "echo $MUSTER_TASK $MUSTER_NAMESPACE $MUSTER_UID $MUSTER_NODE $MUSTER_ATTEMPT $MUSTER_LEASE; \
        echo $A '$A'; id -u; grep NoNewPrivs /proc/self/status; pwd; touch here $MUSTER_RUN_DIR/there && echo wrote; echo oops >&2";
    let mut spec = sh(script);
    spec["run"]["process"]["env"] = json!([{ "name": "A", "value": "b $c" }]);
    spec["run"]["process"]["user"] = json!("nobody");
    controller.assign_with(proto::Assignment {
        uid: "env".to_owned(),
        namespace: "lab".to_owned(),
        name: "drive".to_owned(),
        spec: serde_json::to_vec(&spec).unwrap(),
        lease: Some(proto::LeaseToken {
            node: "robot-1".to_owned(),
            group: "body".to_owned(),
            epoch: 3,
            sequence: vec![],
        }),
        ..proto::Assignment::default()
    });
    let end = controller.wait_end("env");
    assert_eq!(end.exit_code, Some(0), "{end:?}");
    let (text, error) =
        controller.logs(proto::LogRequest { id: 1, uid: "env".to_owned(), ..Default::default() });
    assert_eq!(error, "");
    let work = agent.task_dir("env").join("work");
    let expected = format!(
        "drive lab env robot-1 1 robot-1.body:3\nb $c $A\n65534\nNoNewPrivs:\t1\n{}\nwrote\n",
        work.display()
    );
    // Two streams have no order between them.
    assert_eq!(text.replacen("oops\n", "", 1), expected);
    assert_eq!(text.matches("oops\n").count(), 1);
}

#[test]
fn a_process_of_another_user_writes_its_own_directories_and_nothing_beside() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut spec = sh("try() { \"$@\" 2>/dev/null && echo could: \"$*\"; }
        try touch $MUSTER_RUN_DIR/../beside
        try mkdir $MUSTER_RUN_DIR/../../another
        try rm $MUSTER_EXECUTOR_SOCKET
        try mv $MUSTER_RUN_DIR/../executor $MUSTER_RUN_DIR/executor
        try cat $MUSTER_RUN_DIR/../task.json
        touch $MUSTER_RUN_DIR/observed here && [ -S $MUSTER_EXECUTOR_SOCKET ] && echo writes its own");
    spec["run"]["process"]["user"] = json!("nobody");
    controller.assign("beside", spec);
    assert_eq!(controller.wait_end("beside").exit_code, Some(0));
    let ask = proto::LogRequest { id: 1, uid: "beside".to_owned(), ..Default::default() };
    assert_eq!(controller.logs(ask).0, "writes its own\n");
    assert!(agent.task_dir("beside").join("run/observed").exists());
}

#[test]
fn the_agent_is_killed_and_its_tasks_go_on() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    let dir = agent.dir.path().to_owned();
    let uids: Vec<String> = (0..8).map(|n| format!("t{n}")).collect();
    for uid in &uids {
        let go = dir.join(format!("go-{uid}"));
        controller.assign(
            uid,
            sh(&format!("while [ ! -e {} ]; do sleep 0.02; done; exit 5", go.display())),
        );
    }
    for uid in &uids {
        controller.wait_running(uid);
    }
    let pids: Vec<(i32, u64)> =
        uids.iter().map(|uid| agent.main_pid(uid, 1)).map(|pid| (pid, start_time(pid))).collect();
    agent.kill();
    // Two end while nobody looks.
    for uid in &uids[..2] {
        std::fs::write(dir.join(format!("go-{uid}")), "").unwrap();
    }
    for (pid, _) in &pids[..2] {
        until("an end without an agent", || (!lives(*pid)).then_some(()));
    }
    agent.spawn();
    controller.wait_hello(2);
    for uid in &uids[..2] {
        let end = controller.wait_end(uid);
        assert_eq!((end.exit_code, end.attempt, end.restarts), (Some(5), 1, 0), "{end:?}");
    }
    for (uid, (pid, time)) in uids.iter().zip(&pids).skip(2) {
        assert!(lives(*pid) && start_time(*pid) == *time, "{uid} is another process");
        std::fs::write(dir.join(format!("go-{uid}")), "").unwrap();
        assert_eq!(controller.wait_end(uid).exit_code, Some(5));
        let sequences: Vec<u64> =
            controller.reports(uid).iter().map(|report| report.sequence).collect();
        assert!(sequences.is_sorted(), "{uid}: {sequences:?}");
        assert!(controller.reports(uid).iter().all(|report| report.attempt <= 1));
    }
    assert_eq!(controller.joins(), 1, "an agent that joined joins again");
}

#[test]
fn who_ignores_sigterm_is_killed_with_all_that_it_started() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    // A child, a grandchild in a session of its own whose parent is gone, and a deaf main process.
    let script = "trap '' TERM; sleep 1000 & (setsid sh -c 'trap \"\" TERM; sleep 1000 & wait' &) ; \
        echo ready; while :; do sleep 1000; done";
    let mut spec = sh(script);
    spec["gracePeriodSeconds"] = json!(30);
    controller.assign("deaf", spec);
    controller.wait_running("deaf");
    let pids =
        until("all processes", || Some(members(&agent, "deaf")).filter(|pids| pids.len() >= 5));
    controller.stop("deaf", 300);
    let end = controller.wait_end("deaf");
    assert_eq!(
        (end.phase(), end.reason.as_str(), end.signal),
        (proto::TaskPhase::Failed, "Stopped", Some(9))
    );
    assert!(pids.iter().all(|pid| !lives(*pid)), "reported as ended while processes live");
    assert!(!agent.group("deaf", 1, "memory").exists(), "the group stays behind");
}

#[test]
fn what_a_program_leaves_behind_ends_with_it() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let dir = agent.dir.path().join("pid");
    let script = format!(
        "(setsid sh -c 'echo $$ > {}; exec sleep 1000' &); while [ ! -s {0} ]; do sleep 0.01; done; exit 3",
        dir.display()
    );
    controller.assign("leaver", sh(&script));
    let end = controller.wait_end("leaver");
    assert_eq!(end.exit_code, Some(3));
    let pid: i32 = std::fs::read_to_string(&dir).unwrap().trim().parse().unwrap();
    assert!(!lives(pid));
}

#[test]
fn a_program_is_asked_to_end_by_the_signal_that_it_names() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let script =
        "trap '' TERM; trap 'exit 9' INT; : > $MUSTER_RUN_DIR/ready; while :; do sleep 0.05; done";
    let mut spec = sh(script);
    spec["stopSignal"] = json!("SIGINT");
    spec["gracePeriodSeconds"] = json!(300);
    controller.assign("named", spec);
    let ready = agent.task_dir("named").join("run/ready");
    until("its trap", || ready.exists().then_some(()));
    controller.stop("named", 300_000);
    let end = controller.wait_end("named");
    assert_eq!((end.exit_code, end.signal), (Some(9), None), "{end:?}");
}

#[test]
fn a_polite_program_ends_within_its_grace() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let script = "trap 'exit 0' TERM; : > $MUSTER_RUN_DIR/ready; while :; do sleep 0.05; done";
    controller.assign("polite", sh(script));
    controller.wait_running("polite");
    let ready = agent.task_dir("polite").join("run/ready");
    until("its trap", || ready.exists().then_some(()));
    controller.stop("polite", 30_000);
    let end = controller.wait_end("polite");
    assert_eq!((end.phase(), end.exit_code), (proto::TaskPhase::Succeeded, Some(0)), "{end:?}");
}

#[test]
fn a_program_that_does_nothing_about_signals_ends_at_sigterm() {
    let controller = Controller::start();
    let _agent = Agent::start(&controller);
    controller.assign("plain", json!({"run": {"process": {"command": ["sleep", "1000"]}}}));
    controller.wait_running("plain");
    controller.stop("plain", 600_000);
    let end = controller.wait_end("plain");
    assert_eq!(end.signal, Some(15), "it heard SIGTERM, long before its grace was over: {end:?}");
}

#[test]
fn a_stop_goes_on_without_the_agent() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    controller.assign("deaf", sh("trap '' TERM; while :; do sleep 1000; done"));
    controller.wait_running("deaf");
    let pid = agent.main_pid("deaf", 1);
    controller.stop("deaf", 700);
    controller.wait("deaf", "stopping", |report| report.phase() == proto::TaskPhase::Stopping);
    until("the order", || {
        agent.task_dir("deaf").join("attempts/1/stop.json").exists().then_some(())
    });
    agent.kill();
    until("the end of the ladder", || (!lives(pid)).then_some(()));
    until("the exit record", || agent.has_exit_record("deaf", 1).then_some(()));
    agent.spawn();
    assert_eq!(controller.wait_end("deaf").reason, "Stopped");
}

#[test]
fn a_killed_shim_loses_the_status_but_no_process() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut spec = sh("sleep 1000 & sleep 1000");
    spec["gracePeriodSeconds"] = json!(1);
    controller.assign("lost", spec);
    controller.wait_running("lost");
    let pids = until("both", || Some(members(&agent, "lost")).filter(|pids| pids.len() >= 3));
    // SAFETY: a signal to a process of this test.
    unsafe { libc::kill(agent.shim_pid("lost", 1), libc::SIGKILL) };
    let end = controller.wait_end("lost");
    assert_eq!((end.reason.as_str(), end.exit_code), ("ShimLost", None), "{end:?}");
    assert!(pids.iter().all(|pid| !lives(*pid)));
}

#[test]
fn a_shim_killed_while_the_agent_was_away() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    let mut spec = sh("trap '' TERM; while :; do sleep 1000; done");
    spec["gracePeriodSeconds"] = json!(0);
    controller.assign("lost", spec);
    controller.wait_running("lost");
    let (pid, shim) = (agent.main_pid("lost", 1), agent.shim_pid("lost", 1));
    agent.kill();
    // SAFETY: a signal to a process of this test.
    unsafe { libc::kill(shim, libc::SIGKILL) };
    until("the shim's end", || (!lives(shim)).then_some(()));
    assert!(lives(pid));
    agent.spawn();
    assert_eq!(controller.wait_end("lost").reason, "ShimLost");
    assert!(!lives(pid));
}

#[test]
fn an_exit_code_outlasts_a_full_disk() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    controller
        .assign("full", sh("until [ -e \"$MUSTER_RUN_DIR/go\" ]; do sleep 0.05; done; exit 9"));
    controller.wait_running("full");
    let dir = agent.task_dir("full");
    // Whoever writes the record finds no room.
    let record = dir.join("attempts/1/exit.json.tmp");
    std::os::unix::fs::symlink("/dev/full", &record).unwrap();
    let program = agent.main_pid("full", 1);
    std::fs::write(dir.join("run/go"), "").unwrap();
    until("the program's end", || (!lives(program)).then_some(()));
    std::fs::remove_file(&record).unwrap();
    let end = controller.wait_end("full");
    assert_eq!((end.exit_code, end.reason.as_str()), (Some(9), "Error"), "{end:?}");
}

#[test]
fn restarts_back_off_and_are_counted() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    // The third attempt stays, so there is time to ask for what was said.
    let script = "echo run $MUSTER_ATTEMPT; [ $MUSTER_ATTEMPT -lt 3 ] || exec sleep 1000; exit 4";
    let mut spec = sh(script);
    spec["restartPolicy"] = json!("OnFailure");
    controller.assign("again", spec);
    let second = controller
        .wait("again", "second end", |report| report.attempt == 2 && report.reason == "BackOff");
    assert_eq!((second.restarts, second.exit_code), (2, Some(4)), "{second:?}");
    let third = controller.wait("again", "third attempt", |report| {
        report.attempt == 3 && report.phase() == proto::TaskPhase::Running
    });
    assert_eq!(third.restarts, 2, "{third:?}");
    let ask = |id, previous| proto::LogRequest {
        id,
        uid: "again".to_owned(),
        previous,
        ..Default::default()
    };
    let mut ids = 1..;
    for (previous, said) in [(false, "run 3\n"), (true, "run 2\n")] {
        until(said, || {
            let id = ids.next()?;
            (controller.logs(ask(id, previous)).0 == said).then_some(())
        });
    }
    controller.stop("again", 0);
    controller.wait_end("again");
    assert!(agent.has_exit_record("again", 3));
}

#[test]
fn output_is_followed_cut_and_cancelled() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let go = agent.dir.path().join("go");
    let script =
        format!("seq 1 1000; while [ ! -e {} ]; do sleep 0.02; done; echo last", go.display());
    controller.assign("talk", sh(&script));
    controller.wait_running("talk");
    let ask = |id, follow, tail_lines| proto::LogRequest {
        id,
        uid: "talk".to_owned(),
        follow,
        tail_lines,
        ..Default::default()
    };
    controller.ask_logs(ask(2, true, None));
    until("what is there", || controller.logs_now(2).ends_with("1000\n").then_some(()));
    controller.ask_logs(ask(1, true, Some(2)));
    until("the last two", || (controller.logs_now(1) == "999\n1000\n").then_some(()));
    controller.cancel_logs(2);
    std::fs::write(&go, "").unwrap();
    controller.wait_end("talk");
    until("the last line", || (controller.logs_now(1) == "999\n1000\nlast\n").then_some(()));
    let (text, _) =
        controller.logs(proto::LogRequest { timestamps: true, ..ask(3, false, Some(1)) });
    let (time, line) = text.split_once(' ').unwrap();
    assert!(time.ends_with('Z') && line == "last\n", "{text}");
    let (_, error) =
        controller.logs(proto::LogRequest { uid: "no".to_owned(), ..ask(4, false, None) });
    assert!(error.contains("does not have"), "{error}");
}

#[test]
fn two_agents_of_one_machine_do_not_meet() {
    let controller = Controller::start();
    let one = Agent::start(&controller);
    controller.assign("mine", sh("sleep 1000"));
    controller.wait_running("mine");
    let pid = one.main_pid("mine", 1);
    let other = Controller::start();
    let mut two = Agent::start_with(&other, &["--cpu", "500m", "--memory", "1Gi"]);
    other.assign("mine", sh("exit 0"));
    other.wait_end("mine");
    two.kill();
    two.spawn();
    other.wait_hello(2);
    assert!(lives(pid));
    let state = other.state().unwrap();
    assert_eq!(state.allocatable.unwrap().cpu_millis, 500);
    // A second agent on the same directory is refused.
    let refused = common::agent::command(one.dir.path(), &one.args).output().unwrap();
    let text = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && text.contains("another agent runs on"), "{text}");
}

#[test]
fn output_is_bounded_and_keeps_the_newest() {
    let controller = Controller::start();
    let args = ["--log-max-size", "64Ki", "--log-max-files", "3"];
    let agent = Agent::start_with(&controller, &args);
    controller.assign("chatty", sh("seq 1 200000"));
    assert_eq!(controller.wait_end("chatty").exit_code, Some(0));
    let attempt = agent.task_dir("chatty").join("attempts/1");
    let size = |name: &str| std::fs::metadata(attempt.join(name)).map_or(0, |file| file.len());
    for name in ["log", "log.1", "log.2"] {
        assert!((1..=64 << 10).contains(&size(name)), "{name}: {}", size(name));
    }
    assert_eq!(size("log.3"), 0);
    let ask = |id, tail_lines| proto::LogRequest {
        id,
        uid: "chatty".to_owned(),
        tail_lines,
        ..Default::default()
    };
    assert_eq!(controller.logs(ask(1, Some(2))).0, "199999\n200000\n");
    // What is left is whole: no line is missing between the files.
    let (text, _) = controller.logs(ask(2, None));
    let numbers: Vec<u32> = text.lines().map(|line| line.parse().unwrap()).collect();
    assert!(numbers.len() > 1_000 && numbers.windows(2).all(|pair| pair[1] == pair[0] + 1));
}

#[test]
fn the_groups_of_a_dead_agent_go_and_come_back_with_it() {
    let controller = Controller::start();
    let mut dead = Agent::start(&controller);
    controller.assign("one", sh("exit 0"));
    controller.wait_end("one");
    let root = dead.group("one", 1, "cpu").parent().unwrap().to_owned();
    assert!(root.is_dir());
    dead.kill();
    // Another agent's start takes them away, of this machine but of another directory.
    let other = Controller::start();
    let mut living = Agent::start(&other);
    assert!(!root.exists(), "{}", root.display());
    dead.spawn();
    controller.wait_hello(2);
    controller.assign("two", sh("exit 0"));
    assert_eq!(controller.wait_end("two").exit_code, Some(0));
    // One that lives keeps its own; one that ends in order, and has no tasks, takes them along.
    living.terminate();
    living.spawn();
    other.wait_hello(2);
    assert!(root.is_dir());
    dead.terminate();
    assert!(!root.exists(), "{}", root.display());
}
