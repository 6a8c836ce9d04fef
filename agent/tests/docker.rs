//! Containers under a real agent and a real Docker Engine. Needs a running engine and busybox-static.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use std::process::Command;
use std::sync::OnceLock;

use common::agent::Agent;
use common::controller::Controller;
use common::cpu::{Accounts, Heavy};
use common::executor::Executor;
use common::until;
use muster_api::wire::agent::v1 as proto;
use muster_api::wire::executor::v1::TaskState;
use serde_json::{Value, json};

const IMAGE: &str = "muster-test/busybox:1";

fn docker(args: &[&str]) -> String {
    let output = Command::new("docker").args(args).output().expect("docker is installed");
    assert!(
        output.status.success(),
        "docker {args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

/// An image of one static binary: nothing is fetched.
fn image() -> &'static str {
    static MADE: OnceLock<()> = OnceLock::new();
    MADE.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let bin = dir.path().join("bin");
        std::fs::create_dir(&bin).unwrap();
        for name in [
            "busybox", "sh", "sleep", "echo", "dd", "cat", "id", "mv", "rm", "mkdir", "mount", "ls",
        ] {
            std::fs::copy("/bin/busybox", bin.join(name)).unwrap();
        }
        let tar = dir.path().join("root.tar");
        let packed = Command::new("tar")
            .args(["-C", dir.path().to_str().unwrap(), "-cf", tar.to_str().unwrap(), "bin"])
            .status()
            .unwrap();
        assert!(packed.success());
        docker(&["import", tar.to_str().unwrap(), IMAGE]);
    });
    IMAGE
}

/// Removes the containers of a test's tasks.
struct Cleanup(Vec<&'static str>);

impl Drop for Cleanup {
    fn drop(&mut self) {
        for uid in &self.0 {
            let ids =
                docker(&["ps", "-aq", "--filter", &format!("label=muster.dev/task-uid={uid}")]);
            for id in ids.lines() {
                docker(&["rm", "-f", id]);
            }
        }
    }
}

fn start(controller: &Controller) -> Agent {
    let agent = Agent::start_with(controller, &["--docker-socket", "/var/run/docker.sock"]);
    until("docker", || {
        let state = controller.state()?;
        state.runtimes.iter().any(|r| r.name == "docker" && r.available).then_some(())
    });
    agent
}

fn sh(script: &str) -> Value {
    json!({ "run": { "container": {
        "image": image(), "command": ["/bin/sh", "-c", script], "network": "None" } } })
}

fn container(uid: &str) -> String {
    until("a container", || {
        let id = docker(&[
            "ps",
            "-aq",
            "--no-trunc",
            "--filter",
            &format!("label=muster.dev/task-uid={uid}"),
        ]);
        (!id.is_empty()).then_some(id)
    })
}

/// A set of capabilities of the first process, by numbers (capabilities(7)).
fn capabilities(status: &str, set: &str) -> Vec<u32> {
    let line = status.lines().find_map(|line| line.strip_prefix(set)).expect(set);
    let bits = u64::from_str_radix(line.trim(), 16).unwrap();
    (0..64).filter(|bit| bits >> bit & 1 == 1).collect()
}

#[test]
fn a_container_has_few_privileges_and_gains_none() {
    let _cleanup = Cleanup(vec!["d-root", "d-user"]);
    let controller = Controller::start();
    let agent = start(&controller);
    let status = |uid: &'static str, spec: Value| {
        controller.assign(uid, spec);
        let end = controller.wait_end(uid);
        assert_eq!(end.exit_code, Some(0), "{end:?}");
        let ask = proto::LogRequest { id: 1, uid: uid.to_owned(), ..Default::default() };
        controller.logs(ask).0
    };
    let root = status("d-root", sh("cat /proc/self/status"));
    assert!(root.contains("NoNewPrivs:\t1\n") && root.contains("Seccomp:\t2\n"), "{root}");
    // CHOWN, DAC_OVERRIDE, FOWNER, FSETID, KILL, SETGID, SETUID, NET_BIND_SERVICE.
    assert_eq!(capabilities(&root, "CapBnd:"), [0, 1, 3, 4, 5, 6, 7, 10], "{root}");

    let mut spec = sh("id -u; echo hello > $MUSTER_RUN_DIR/there; cat /proc/self/status");
    spec["run"]["container"]["user"] = json!("4711:4712");
    let user = status("d-user", spec);
    assert!(user.starts_with("4711\n") && user.contains("Gid:\t4712\t"), "{user}");
    assert!(capabilities(&user, "CapEff:").is_empty(), "{user}");
    let there = std::fs::read_to_string(agent.task_dir("d-user").join("run/there")).unwrap();
    assert_eq!(there, "hello\n");
}

/// Root in a container, which tries each of these and says what it could do.
const TRIES: &str = "try() { \"$@\" 2>/dev/null && echo could: \"$*\"; }
    try sh -c 'echo x > /run/muster/observed'
    try mkdir /run/muster/sensors/lidar
    try rm -r /run/muster/sensors
    try mv /run/muster/own /run/muster/other
    try rm $MUSTER_EXECUTOR_SOCKET
    try mv $MUSTER_EXECUTOR_SOCKET $MUSTER_EXECUTOR_SOCKET.old
    try sh -c 'echo x > /run/muster-executor/x'
    try mount -o remount,rw /run/muster
    echo '/scan 9.8' > $MUSTER_RUN_DIR/observed && echo tells
    echo carries a tray > $MUSTER_RUN_DIR/mission-lock && echo locks
    [ -S $MUSTER_EXECUTOR_SOCKET ] && echo sees the socket
    ls -1 /run/muster
    until [ -e $MUSTER_RUN_DIR/go ]; do sleep 0.1; done";

#[test]
fn a_container_writes_its_own_directory_and_nothing_beside() {
    let _cleanup = Cleanup(vec!["d-beside"]);
    let controller = Controller::start();
    let agent = start(&controller);
    controller.assign("d-beside", sh(TRIES));
    let lock = until("a mission", || controller.state()?.mission_locks.pop());
    assert_eq!(lock.reason, "carries a tray");
    // Where the agent looks is where it looked before: containers of an older one go on to count.
    let run = agent.task_dir("d-beside").join("run");
    assert_eq!(std::fs::read_to_string(run.join("observed")).unwrap(), "/scan 9.8\n");
    std::fs::write(run.join("go"), "").unwrap();
    assert_eq!(controller.wait_end("d-beside").exit_code, Some(0));
    let ask = proto::LogRequest { id: 1, uid: "d-beside".to_owned(), ..Default::default() };
    let said = controller.logs(ask).0;
    assert_eq!(said, "tells\nlocks\nsees the socket\nown\nsensors\n");
    controller.release("d-beside");
    until("the directory to go", || (!agent.task_dir("d-beside").exists()).then_some(()));
}

#[test]
fn a_container_runs_and_its_exit_code_is_reported() {
    let _cleanup = Cleanup(vec!["d-ok", "d-bad", "d-none"]);
    let controller = Controller::start();
    let _agent = start(&controller);
    let mut spec = sh("echo out $MUSTER_TASK $A; pwd; echo data > /data/file; exit 0");
    let dir = tempfile::tempdir().unwrap();
    spec["run"]["container"]["env"] = json!([{ "name": "A", "value": "b" }]);
    spec["run"]["container"]["workingDir"] = json!("/bin");
    spec["run"]["container"]["mounts"] = json!([{ "hostPath": dir.path(), "mountPath": "/data" }]);
    controller.assign("d-ok", spec);
    let end = controller.wait_end("d-ok");
    assert_eq!((end.exit_code, end.reason.as_str()), (Some(0), "Completed"), "{end:?}");
    let ask = proto::LogRequest { id: 1, uid: "d-ok".to_owned(), ..Default::default() };
    assert_eq!(controller.logs(ask).0, "out task-d-ok b\n/bin\n");
    assert_eq!(std::fs::read_to_string(dir.path().join("file")).unwrap(), "data\n");
    controller.assign("d-bad", sh("exit 6"));
    assert_eq!(controller.wait_end("d-bad").exit_code, Some(6));
    let mut spec = sh("");
    spec["run"]["container"]["command"] = json!(["/no/such"]);
    controller.assign("d-none", spec);
    let end = controller.wait_end("d-none");
    assert!(end.reason == "StartError" && end.message.contains("/no/such"), "{end:?}");
    controller.release("d-ok");
    until("the container to go", || {
        docker(&["ps", "-aq", "--filter", "label=muster.dev/task-uid=d-ok"])
            .is_empty()
            .then_some(())
    });
}

#[test]
fn a_container_is_asked_to_end_by_the_signal_that_it_names() {
    let _cleanup = Cleanup(vec!["d-named"]);
    let controller = Controller::start();
    let agent = start(&controller);
    let trap = "trap '' TERM; trap 'exit 9' INT; : > $MUSTER_RUN_DIR/ready";
    let mut spec = sh(&format!("{trap}; while :; do sleep 0.05; done"));
    spec["stopSignal"] = json!("SIGINT");
    controller.assign("d-named", spec);
    let ready = agent.task_dir("d-named").join("run/ready");
    until("its trap", || ready.exists().then_some(()));
    controller.stop("d-named", 300_000);
    let end = controller.wait_end("d-named");
    assert_eq!((end.exit_code, end.signal), (Some(9), None), "{end:?}");
}

#[test]
fn limits_are_the_kernels() {
    let _cleanup = Cleanup(vec!["d-spin", "d-fat-1", "d-fat-2", "d-fat-3"]);
    let controller = Controller::start();
    let _agent = start(&controller);
    let mut spec = sh("while :; do :; done");
    spec["resources"] =
        json!({ "cpu": "500m", "memory": "64Mi", "pids": 20, "io": { "writeBps": "1Mi" } });
    controller.assign("d-spin", spec);
    controller.wait_running("d-spin");
    let found: Value = serde_json::from_str(&docker(&["inspect", &container("d-spin")])).unwrap();
    let pid = found[0]["State"]["Pid"].as_i64().unwrap().try_into().unwrap();
    let accounts = Accounts::of(pid);
    let heavy = Heavy::new(accounts.cpu.parent().unwrap());
    accounts.assert_share(0.5);
    drop(heavy);
    let told = until("usage", || controller.usage("d-spin").filter(|usage| usage.cpu_millis > 0));
    assert!(told.memory_bytes > 0, "{told:?}");
    let host = &found[0]["HostConfig"];
    assert_eq!(
        (host["Memory"].as_u64(), host["MemorySwap"].as_u64()),
        (Some(64 << 20), Some(64 << 20))
    );
    assert_eq!(
        (host["PidsLimit"].as_u64(), host["NanoCpus"].as_u64()),
        (Some(20), Some(500_000_000))
    );
    assert_eq!(host["BlkioDeviceWriteBps"][0]["Rate"].as_u64(), Some(1 << 20));
    controller.stop("d-spin", 0);
    controller.wait_end("d-spin");
    let mut spec = sh("exec dd if=/dev/zero of=/dev/null bs=200M count=1");
    spec["resources"] = json!({ "memory": "64Mi" });
    // The engine tells of an end and of its cause apart, and may be late with the cause.
    let told = ["d-fat-1", "d-fat-2", "d-fat-3"].into_iter().any(|uid| {
        controller.assign(uid, spec.clone());
        let end = controller.wait_end(uid);
        assert_eq!(end.exit_code, Some(137), "{end:?}");
        end.reason == "OOMKilled"
    });
    assert!(told, "of none it is said that it was killed for its memory");
}

#[test]
fn containers_outlive_the_agent() {
    let _cleanup = Cleanup(vec!["d-keep", "d-end"]);
    let controller = Controller::start();
    let mut agent = start(&controller);
    controller.assign("d-keep", sh("while :; do sleep 1; done"));
    controller
        .assign("d-end", sh("while [ ! -e $MUSTER_RUN_DIR/go ]; do sleep 0.05; done; exit 8"));
    controller.wait_running("d-keep");
    controller.wait_running("d-end");
    let pid = |uid: &str| docker(&["inspect", "-f", "{{.State.Pid}}", &container(uid)]);
    let before = pid("d-keep");
    agent.kill();
    std::fs::write(agent.task_dir("d-end").join("run/go"), "").unwrap();
    until("the end", || (pid("d-end") == "0").then_some(()));
    agent.spawn();
    // The first word about it: whoever believed that it still runs would end what took its place.
    let hello = controller.wait_hello(2);
    let told = hello.tasks.iter().find(|task| task.uid == "d-end").expect("it is the agent's");
    assert_eq!(told.phase(), proto::TaskPhase::Failed, "{told:?}");
    let end = controller.wait_end("d-end");
    assert_eq!((end.exit_code, end.attempt), (Some(8), 1));
    assert_eq!(pid("d-keep"), before);
    controller.stop("d-keep", 1_000);
    let end = controller.wait_end("d-keep");
    assert_eq!((end.reason.as_str(), end.exit_code), ("Stopped", Some(137)), "{end:?}");
}

#[test]
fn an_image_that_cannot_be_had_says_so_and_is_tried_again() {
    let _cleanup = Cleanup(vec!["d-image"]);
    let controller = Controller::start();
    let _agent = start(&controller);
    let mut spec = sh("exit 0");
    // A name of this run's own: nobody can have left it behind.
    let name = format!("muster-test/none-{}:1", std::process::id());
    spec["run"]["container"]["image"] = json!(name);
    spec["run"]["container"]["pullPolicy"] = json!("Never");
    controller.assign("d-image", spec);
    let waits = controller.wait("d-image", "reason", |report| report.reason == "ImagePullFailed");
    assert_eq!(waits.phase(), proto::TaskPhase::Starting);
    assert!(waits.message.contains(&name), "{waits:?}");
    docker(&["tag", image(), &name]);
    assert_eq!(controller.wait_end("d-image").exit_code, Some(0));
    docker(&["rmi", "-f", &name]);
}

#[test]
fn a_container_that_may_not_run_alone_ends_alone() {
    let _cleanup = Cleanup(vec!["d-tied"]);
    let controller = Controller::start();
    let mut agent = start(&controller);
    let mut spec = sh("while :; do sleep 1; done");
    spec["onDisconnect"] = json!({ "policy": "Stop", "after": "5s" });
    spec["gracePeriodSeconds"] = json!(0);
    controller.assign("d-tied", spec);
    controller.wait_running("d-tied");
    agent.kill();
    let running = || docker(&["inspect", "-f", "{{.State.Running}}", &container("d-tied")]);
    until("the end by the guard", || (running() == "false").then_some(()));
    agent.spawn();
    assert_eq!(controller.wait_end("d-tied").reason, "Disconnected");
}

#[test]
fn a_container_removed_by_somebody_else_is_lost() {
    let _cleanup = Cleanup(vec!["d-gone"]);
    let controller = Controller::start();
    let _agent = start(&controller);
    controller.assign("d-gone", sh("while :; do sleep 1; done"));
    controller.wait_running("d-gone");
    docker(&["rm", "-f", &container("d-gone")]);
    let end = controller.wait_end("d-gone");
    assert_eq!(end.phase(), proto::TaskPhase::Failed);
    assert!(matches!(end.reason.as_str(), "ContainerLost" | "Error"), "{end:?}");
}

#[test]
fn a_container_is_an_executor_and_its_limits_follow_its_works() {
    let _cleanup = Cleanup(vec!["d-exec"]);
    let controller = Controller::start();
    let agent = start(&controller);
    let mut spec = sh("[ -S $MUSTER_EXECUTOR_SOCKET ] && echo it is there; exec sleep 1000");
    spec["resources"] = json!({ "cpu": "100m", "memory": "64Mi" });
    controller.assign("d-exec", spec);
    let mut executor = Executor::register(&agent, "d-exec", &[]);
    controller.wait_running("d-exec");
    let work = json!({
        "resources": { "cpu": "200m", "memory": "32Mi" },
        "run": { "executor": { "task": "task-d-exec", "data": {} } },
    });
    controller.assign("d-work", work);
    assert_eq!(executor.launched().task, "d-work");
    let id = container("d-exec");
    let limits = docker(&["inspect", "-f", "{{.HostConfig.NanoCpus}} {{.HostConfig.Memory}}", &id]);
    assert_eq!(limits, format!("300000000 {}", 96 << 20), "before it is handed over");
    executor.update("d-work", TaskState::Running);
    controller.wait_running("d-work");
    let mut ids = 1..;
    until("its own look at its socket", || {
        let id = ids.next()?;
        let ask = proto::LogRequest { id, uid: "d-exec".to_owned(), ..Default::default() };
        (controller.logs(ask).0 == "it is there\n").then_some(())
    });
    docker(&["kill", &id]);
    assert_eq!(controller.wait_end("d-work").reason, "ExecutorLost");
    assert_eq!(controller.wait_end("d-exec").signal, Some(9));
}

/// Waits until the newest report says whether the task is ready.
#[track_caller]
fn wait_ready(controller: &Controller, uid: &str, ready: bool) -> proto::TaskReport {
    until("a word on readiness", || {
        controller.reports(uid).pop().filter(|report| report.ready == Some(ready))
    })
}

/// A container that serves its run directory, and is asked for a file of it.
fn served(network: &str, port: u16) -> Value {
    json!({
        "run": { "container": { "image": image(), "network": network,
            "command": ["/bin/busybox", "httpd", "-f", "-p", port.to_string(), "-h", "/run/muster/own"] } },
        "readiness": { "http": { "path": "/ready", "port": port }, "period": "100ms",
            "timeout": "20s", "initialDelay": "2s", "failureThreshold": 1 },
        "liveness": { "tcp": { "port": port }, "period": "100ms", "timeout": "20s",
            "initialDelay": "2s", "failureThreshold": 1000 },
    })
}

/// A free port of the machine, below those that the kernel gives away by itself: it stays free until it is used.
fn free_port() -> u16 {
    let given = std::fs::read_to_string("/proc/sys/net/ipv4/ip_local_port_range").unwrap();
    let least: u16 = given.split_whitespace().next().unwrap().parse().unwrap();
    let ports = 20_000..least.max(21_000);
    // Others that look at the same time begin elsewhere.
    let first = std::process::id() as usize % ports.len();
    let mut turn = ports.clone().cycle().skip(first).take(ports.len());
    turn.find(|port| std::net::TcpListener::bind(("0.0.0.0", *port)).is_ok()).unwrap()
}

#[test]
fn probes_reach_a_container_in_each_network() {
    let _cleanup = Cleanup(vec!["d-net-none", "d-net-bridge", "d-net-host"]);
    let controller = Controller::start();
    let agent = start(&controller);
    let free = free_port();
    // The same port in two networks of their own: each is asked in its own.
    for (uid, network, port) in
        [("d-net-none", "None", 80), ("d-net-bridge", "Bridge", 80), ("d-net-host", "Host", free)]
    {
        controller.assign(uid, served(network, port));
        controller.wait_running(uid);
    }
    for uid in ["d-net-none", "d-net-bridge", "d-net-host"] {
        controller.wait(uid, "answer", |report| report.message.contains("HTTP status 404"));
        let file = agent.task_dir(uid).join("run/ready");
        std::fs::write(&file, "").unwrap();
        wait_ready(&controller, uid, true);
        std::fs::remove_file(&file).unwrap();
        wait_ready(&controller, uid, false);
        controller.stop(uid, 0);
        assert_eq!(controller.wait_end(uid).attempt, 1, "it was alive");
    }
}

#[test]
fn a_check_runs_inside_its_container_and_is_killed_when_it_takes_too_long() {
    let _cleanup = Cleanup(vec!["d-check", "d-late", "d-nocheck"]);
    let controller = Controller::start();
    let agent = start(&controller);
    let exec = |argv: Value| json!({ "exec": { "command": argv }, "period": "200ms", "timeout": "20s", "failureThreshold": 1 });
    let mut spec = sh("trap 'exit 0' TERM; while :; do sleep 0.1; done");
    spec["run"]["container"]["env"] = json!([{ "name": "A", "value": "b" }]);
    spec["readiness"] = exec(json!([
        "/bin/sh",
        "-c",
        "[ -e $MUSTER_RUN_DIR/ok ] || { echo $A is missing; exit 3; }"
    ]));
    spec["liveness"] =
        exec(json!(["/bin/sh", "-c", "[ ! -e $MUSTER_RUN_DIR/hung ] || { echo hung; exit 1; }"]));
    controller.assign("d-check", spec);
    controller
        .wait("d-check", "answer", |r| r.message.contains("exited with code 3: b is missing"));
    let run = agent.task_dir("d-check").join("run");
    std::fs::write(run.join("ok"), "").unwrap();
    wait_ready(&controller, "d-check", true);
    std::fs::write(run.join("hung"), "").unwrap();
    let end = controller.wait_end("d-check");
    assert_eq!((end.phase(), end.reason.as_str()), (proto::TaskPhase::Failed, "LivenessFailed"));
    assert_eq!(end.message, "its liveness probe failed: exited with code 1: hung");

    let mut spec = sh("exec sleep 1000");
    spec["readiness"] = exec(json!(["/bin/sleep", "1234"]));
    spec["readiness"]["timeout"] = json!("5s");
    spec["readiness"]["period"] = json!("1h");
    controller.assign("d-late", spec);
    let id = container("d-late");
    controller.wait("d-late", "timeout", |r| r.message.contains("no answer within 5s"));
    until("the end of the check", || (!docker(&["top", &id]).contains("1234")).then_some(()));
    controller.stop("d-late", 0);
    controller.wait_end("d-late");

    let mut spec = sh("exec sleep 1000");
    spec["startup"] = exec(json!(["/no/such/check"]));
    controller.assign("d-nocheck", spec);
    let end = controller.wait_end("d-nocheck");
    assert_eq!(end.reason, "StartupFailed");
    assert!(end.message.contains("/no/such/check"), "{end:?}");
}
