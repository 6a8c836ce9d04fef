//! Probes of processes under a real agent: real checks, real control groups. Needs root and cgroups.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::atomic::{AtomicU16, Ordering};
use std::sync::{Arc, Mutex};

use common::agent::Agent;
use common::controller::Controller;
use common::{lives, until};
use muster_api::wire::agent::v1 as proto;
use rustls::pki_types::PrivateKeyDer;
use rustls::pki_types::pem::PemObject;
use serde_json::{Value, json};

/// A task that lives until it is told to end, and ends well then; `obeys` in its run directory says that it would by now.
fn obedient() -> Value {
    sh("trap 'exit 0' TERM; : > $MUSTER_RUN_DIR/obeys; while :; do sleep 0.05; done")
}

fn sh(script: &str) -> Value {
    json!({ "run": { "process": { "command": ["sh", "-c", script] } } })
}

fn exec(script: &str) -> Value {
    json!({ "exec": { "command": ["sh", "-c", script] }, "period": "100ms", "timeout": "10s" })
}

fn last(controller: &Controller, uid: &str) -> Option<proto::TaskReport> {
    controller.reports(uid).pop()
}

/// Waits until the newest report says whether the task is ready.
#[track_caller]
fn wait_ready(controller: &Controller, uid: &str, ready: bool) -> proto::TaskReport {
    until("a word on readiness", || {
        last(controller, uid)
            .filter(|r| r.phase() == proto::TaskPhase::Running && r.ready == Some(ready))
    })
}

/// Waits until the newest report's message has these words.
#[track_caller]
fn wait_said(controller: &Controller, uid: &str, words: &str) -> proto::TaskReport {
    controller.wait(uid, words, |report| report.message.contains(words))
}

/// A server that answers with a status that can be set.
struct Server {
    port: u16,
    status: Arc<AtomicU16>,
    heard: Arc<Mutex<String>>,
}

impl Server {
    fn start() -> Server {
        Self::start_with(None)
    }

    /// With a certificate that nobody has signed.
    fn start_tls() -> Server {
        let key = rcgen::KeyPair::generate().unwrap();
        let params = rcgen::CertificateParams::new(vec!["robot".to_owned()]).unwrap();
        let certificate = params.self_signed(&key).unwrap();
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let config = rustls::ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_no_client_auth()
            .with_single_cert(
                vec![certificate.der().clone()],
                PrivateKeyDer::from_pem_slice(key.serialize_pem().as_bytes()).unwrap(),
            )
            .unwrap();
        Self::start_with(Some(Arc::new(config)))
    }

    fn start_with(tls: Option<Arc<rustls::ServerConfig>>) -> Server {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let (status, heard) = (Arc::new(AtomicU16::new(503)), Arc::new(Mutex::default()));
        let server = Server { port, status: Arc::clone(&status), heard: Arc::clone(&heard) };
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let (mut stream, status) = (stream.unwrap(), status.load(Ordering::SeqCst));
                match &tls {
                    None => answer(&mut stream, status, &heard),
                    Some(config) => {
                        let session = rustls::ServerConnection::new(Arc::clone(config)).unwrap();
                        answer(&mut rustls::StreamOwned::new(session, stream), status, &heard);
                    }
                }
            }
        });
        server
    }

    fn say(&self, status: u16) {
        self.status.store(status, Ordering::SeqCst);
    }
}

fn answer(stream: &mut (impl Read + Write), status: u16, heard: &Mutex<String>) {
    let mut request = Vec::new();
    let mut buffer = [0; 1024];
    while !request.windows(4).any(|end| end == b"\r\n\r\n") {
        match stream.read(&mut buffer) {
            // A check of the connection alone says nothing.
            Ok(0) | Err(_) => return,
            Ok(n) => request.extend_from_slice(&buffer[..n]),
        }
    }
    *heard.lock().unwrap() = String::from_utf8(request).unwrap();
    let body = "the map\nis loading";
    let _ = write!(stream, "HTTP/1.1 {status} X\r\ncontent-length: {}\r\n\r\n{body}", body.len());
}

#[test]
fn a_file_says_whether_a_task_is_ready() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut spec = obedient();
    spec["readiness"] = exec("[ -e $MUSTER_RUN_DIR/ready ] || { echo no map yet; exit 4; }");
    spec["readiness"]["failureThreshold"] = json!(1);
    controller.assign("file", spec);
    controller.assign("plain", obedient());
    let waits = wait_said(&controller, "file", "no map yet");
    assert_eq!((waits.ready, waits.reason.as_str()), (Some(false), "NotReady"));
    assert_eq!(waits.message, "its readiness probe failed: exited with code 4: no map yet");
    let file = agent.task_dir("file").join("run/ready");
    std::fs::write(&file, "").unwrap();
    assert_eq!(wait_ready(&controller, "file", true).message, "");
    std::fs::remove_file(&file).unwrap();
    wait_ready(&controller, "file", false);
    std::fs::write(&file, "").unwrap();
    wait_ready(&controller, "file", true);
    controller.stop("file", 1_000);
    let end = controller.wait_end("file");
    assert_eq!((end.ready, end.attempt, end.reason.as_str()), (Some(false), 1, "Stopped"));
    assert_eq!(controller.wait_running("plain").ready, None, "nothing says so or not");
}

/// What a process says of itself.
const WHO: &str = "echo $(id -u):$(id -g) $(pwd) $A $MUSTER_UID $(sort /proc/self/cgroup)";

#[test]
fn a_check_is_where_its_task_is() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut spec = sh(&format!("{WHO} > $MUSTER_RUN_DIR/task; exec sleep 1000"));
    spec["run"]["process"]["user"] = json!("nobody");
    spec["run"]["process"]["workingDir"] = json!("/tmp");
    spec["run"]["process"]["env"] = json!([{ "name": "A", "value": "b c" }]);
    spec["readiness"] = exec(&format!("{WHO} > $MUSTER_RUN_DIR/check"));
    controller.assign("where", spec);
    wait_ready(&controller, "where", true);
    let run = agent.task_dir("where").join("run");
    // One that is being written is read again.
    let read = |name: &str| {
        let text = || std::fs::read_to_string(run.join(name)).ok();
        until(name, || text().filter(|text| text.ends_with('\n')))
    };
    let told = read("task");
    assert!(told.starts_with("65534:65534 /tmp b c where "), "{told}");
    assert_eq!(read("check"), told);
    controller.stop("where", 0);
    controller.wait_end("where");
}

#[test]
fn http_and_tcp_are_asked() {
    let controller = Controller::start();
    let _agent = Agent::start(&controller);
    let server = Server::start();
    let mut spec = obedient();
    spec["readiness"] = json!({
        "http": { "path": "/ready?deep=1", "port": server.port,
            "headers": [{ "name": "Host", "value": "robot" }, { "name": "x-probe", "value": "y" }] },
        "period": "100ms", "failureThreshold": 2, "timeout": "10s",
    });
    spec["liveness"] =
        json!({ "tcp": { "port": server.port }, "period": "100ms", "timeout": "10s" });
    controller.assign("web", spec);
    wait_said(&controller, "web", "HTTP status 503: the map is loading");
    let heard = server.heard.lock().unwrap().to_lowercase();
    assert!(heard.starts_with("get /ready?deep=1 http/1.1\r\n"), "{heard}");
    assert!(heard.contains("host: robot\r\n") && heard.contains("x-probe: y\r\n"), "{heard}");
    for (status, ready) in [(200, true), (400, false), (302, true), (500, false)] {
        server.say(status);
        wait_ready(&controller, "web", ready);
    }
    // A port of which nobody hears, and at which nobody can begin to: a connection's own end is there.
    let any = TcpListener::bind("127.0.0.1:0").unwrap();
    let held = TcpStream::connect(any.local_addr().unwrap()).unwrap();
    let port = held.local_addr().unwrap().port();
    let mut spec = obedient();
    spec["startup"] = exec("[ -e $MUSTER_RUN_DIR/obeys ]");
    spec["startup"]["failureThreshold"] = json!(10_000);
    spec["liveness"] = json!({ "tcp": { "port": port, "host": "localhost" }, "period": "100ms", "failureThreshold": 2 });
    controller.assign("deaf", spec);
    let end = controller.wait_end("deaf");
    assert_eq!((end.phase(), end.reason.as_str()), (proto::TaskPhase::Failed, "LivenessFailed"));
    let words =
        format!("its liveness probe failed 2 times in a row: no connection to 127.0.0.1:{port}");
    assert!(end.message.starts_with(&words), "{}", end.message);
    assert_eq!(end.exit_code, Some(0), "its program obeyed, and has failed all the same");
    controller.stop("web", 0);
    controller.wait_end("web");
}

#[test]
fn https_is_asked_whoever_answers() {
    let controller = Controller::start();
    let _agent = Agent::start(&controller);
    let server = Server::start_tls();
    let mut spec = obedient();
    spec["readiness"] = json!({ "http": { "port": server.port, "scheme": "HTTPS" }, "period": "100ms",
        "timeout": "10s", "failureThreshold": 1 });
    controller.assign("tls", spec);
    wait_said(&controller, "tls", "HTTP status 503: the map is loading");
    server.say(200);
    wait_ready(&controller, "tls", true);
    controller.stop("tls", 0);
    controller.wait_end("tls");
}

#[test]
fn a_task_that_is_not_alive_starts_again_and_backs_off() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut spec = obedient();
    spec["restartPolicy"] = json!("OnFailure");
    spec["liveness"] =
        exec("[ ! -e $MUSTER_RUN_DIR/hung ] || { rm $MUSTER_RUN_DIR/hung; echo hung; exit 1; }");
    spec["liveness"]["failureThreshold"] = json!(1);
    spec["readiness"] = exec("true");
    controller.assign("alive", spec);
    wait_ready(&controller, "alive", true);
    std::fs::write(agent.task_dir("alive").join("run/hung"), "").unwrap();
    let stops = controller.wait("alive", "stop", |r| r.reason == "LivenessFailed");
    assert_eq!((stops.phase(), stops.ready), (proto::TaskPhase::Stopping, Some(false)));
    let waits = controller.wait("alive", "back-off", |r| r.reason == "BackOff");
    assert!(waits.message.contains("exited with code 1: hung; starts again in 1 s"), "{waits:?}");
    let again = until("another attempt", || last(&controller, "alive").filter(|r| r.attempt == 2));
    assert_eq!(again.restarts, 1);
    wait_ready(&controller, "alive", true);
    controller.stop("alive", 0);
    controller.wait_end("alive");
}

#[test]
fn start_up_holds_the_others_back_and_fails_by_itself() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut spec = obedient();
    spec["startup"] = exec("[ -e $MUSTER_RUN_DIR/up ]");
    spec["startup"]["failureThreshold"] = json!(10_000);
    spec["liveness"] = exec("touch $MUSTER_RUN_DIR/live");
    controller.assign("slow", spec);
    let waits = wait_said(&controller, "slow", "its start-up probe failed: exited with code 1");
    assert_eq!((waits.ready, waits.reason.as_str()), (Some(false), "StartingUp"));
    let run = agent.task_dir("slow").join("run");
    assert!(!run.join("live").exists());
    std::fs::write(run.join("up"), "").unwrap();
    wait_ready(&controller, "slow", true);
    until("a check of liveness", || run.join("live").exists().then_some(()));

    let mut spec = obedient();
    spec["startup"] = json!({ "exec": { "command": ["/no/such/check"] }, "period": "100ms" });
    controller.assign("never", spec);
    let end = controller.wait_end("never");
    assert_eq!((end.phase(), end.reason.as_str()), (proto::TaskPhase::Failed, "StartupFailed"));
    assert!(
        end.message.contains("3 times in a row: failed to execute \"/no/such/check\""),
        "{end:?}"
    );
    controller.stop("slow", 0);
    controller.wait_end("slow");
}

fn pid_in(file: &Path) -> i32 {
    until("a pid", || std::fs::read_to_string(file).ok()?.trim().parse().ok())
}

#[test]
fn a_check_that_takes_too_long_is_killed_whole_and_none_pile_up() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut spec = obedient();
    // The second process is in the check's group, and would be left.
    spec["readiness"] = exec("sleep 1000 & echo $! > $MUSTER_RUN_DIR/child; echo loading; wait");
    spec["readiness"]["timeout"] = json!("5s");
    spec["readiness"]["period"] = json!("1h");
    // Each takes longer than the period.
    spec["liveness"] =
        exec("cd $MUSTER_RUN_DIR; mkdir one || touch two; sleep 0.3; rmdir one; echo >> count");
    controller.assign("late", spec);
    let late = wait_said(&controller, "late", "no answer within 5s: loading");
    assert_eq!(late.ready, Some(false));
    let run = agent.task_dir("late").join("run");
    let child = pid_in(&run.join("child"));
    until("the end of the check's child", || (!lives(child)).then_some(()));
    let count = || std::fs::read_to_string(run.join("count")).map_or(0, |text| text.len());
    until("some checks", || (count() > 3).then_some(()));
    assert!(!run.join("two").exists(), "two at a time");
    controller.stop("late", 0);
    controller.wait_end("late");
}

#[test]
fn a_check_ends_with_its_task() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let mut spec = sh("sleep 1000");
    spec["readiness"] =
        exec("echo $$ > $MUSTER_RUN_DIR/check; trap '' TERM; while :; do sleep 0.05; done");
    spec["readiness"]["timeout"] = json!("1h");
    controller.assign("ends", spec);
    let check = pid_in(&agent.task_dir("ends").join("run/check"));
    assert!(lives(check));
    controller.stop("ends", 600_000);
    let end = controller.wait_end("ends");
    assert_eq!(end.signal, Some(15), "nobody waited for the check: {end:?}");
    assert!(!lives(check), "it is told to have ended");
}

#[test]
fn the_agent_is_killed_and_its_probes_go_on_without_a_flap() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    let mut spec = obedient();
    spec["startup"] = exec("[ ! -e $MUSTER_RUN_DIR/once ] && touch $MUSTER_RUN_DIR/once");
    // While `stuck` is there, a check does not come back.
    spec["readiness"] = exec(
        "cd $MUSTER_RUN_DIR; while [ -e stuck ]; do echo $$ > held; sleep 0.02; done; [ ! -e bad ]",
    );
    spec["readiness"]["timeout"] = json!("1h");
    controller.assign("kept", spec);
    wait_ready(&controller, "kept", true);
    let run = agent.task_dir("kept").join("run");
    let before = agent.main_pid("kept", 1);
    std::fs::write(run.join("stuck"), "").unwrap();
    let held = || {
        let pid: i32 = std::fs::read_to_string(run.join("held")).ok()?.trim().parse().ok()?;
        Some(pid).filter(|pid| lives(*pid))
    };
    let check = until("a check under way", held);
    agent.kill();
    until("the end of the check with its agent", || (!lives(check)).then_some(()));
    let told = controller.reports("kept").len();
    agent.spawn();
    let hello = controller.wait_hello(2);
    assert_eq!(hello.tasks.iter().map(|t| t.ready).collect::<Vec<_>>(), [Some(true)]);
    // The checks go on, and start-up, which would fail now, is not asked again.
    until("a check of the new life", held);
    std::fs::write(run.join("bad"), "").unwrap();
    std::fs::remove_file(run.join("stuck")).unwrap();
    let bad = wait_ready(&controller, "kept", false);
    assert_eq!((bad.attempt, agent.main_pid("kept", 1)), (1, before));
    let since = controller.reports("kept").split_off(told);
    let flaps = since.iter().take_while(|r| r.ready == Some(true)).count();
    assert!(since[flaps..].iter().all(|r| r.ready == Some(false)), "{since:#?}");
    controller.stop("kept", 0);
    controller.wait_end("kept");
}

#[test]
fn an_attempt_that_failed_its_probe_is_ended_by_the_next_life_of_the_agent() {
    let controller = Controller::start();
    let mut agent = Agent::start(&controller);
    let mut spec = sh("trap '' TERM; : > $MUSTER_RUN_DIR/deaf; while :; do sleep 0.05; done");
    spec["gracePeriodSeconds"] = json!(600);
    spec["liveness"] = exec("[ ! -e $MUSTER_RUN_DIR/deaf ] || { echo hung; exit 1; }");
    controller.assign("stuck", spec);
    let stops = controller.wait("stuck", "stop", |r| r.reason == "LivenessFailed");
    assert_eq!(stops.phase(), proto::TaskPhase::Stopping);
    agent.kill();
    agent.spawn();
    controller.wait_hello(2);
    // SAFETY: a signal to the task's own program.
    unsafe { libc::kill(agent.main_pid("stuck", 1), libc::SIGKILL) };
    let end = controller.wait_end("stuck");
    assert_eq!((end.reason.as_str(), end.signal), ("LivenessFailed", Some(9)), "{end:?}");
}

#[test]
fn a_process_with_a_network_of_its_own_is_reached_in_it_and_reaches_nobody() {
    let controller = Controller::start();
    let agent = Agent::start(&controller);
    let outside = Server::start();
    outside.say(200);
    // Serves on its own loopback; the port is another's on the node's.
    let server = format!(
        "import socket\ns = socket.create_server(('127.0.0.1', {}))\nwhile True: s.accept()",
        outside.port
    );
    let process = json!({ "command": ["python3", "-c", server], "network": "None" });
    let mut spec = json!({ "run": { "process": process } });
    spec["readiness"] = json!({ "tcp": { "port": outside.port }, "period": "100ms" });
    // A check beside it is in the same network: it sees that port listening, and no interface but the loopback.
    let port = format!("{:04X}", outside.port);
    let alone = "[ $(grep -c : /proc/net/dev) = 1 ]";
    spec["startup"] = exec(&format!("grep -q ':{port} 00000000:0000 0A' /proc/net/tcp && {alone}"));
    spec["startup"]["failureThreshold"] = json!(600);
    controller.assign("alone", spec);
    wait_ready(&controller, "alone", true);
    let pid = agent.main_pid("alone", 1);
    let of = |pid: &str, which| std::fs::read_link(format!("/proc/{pid}/ns/{which}")).unwrap();
    for which in ["net", "ipc"] {
        assert_ne!(of(&pid.to_string(), which), of("self", which), "{which}");
    }
    assert_eq!(*outside.heard.lock().unwrap(), "", "nobody came to the one outside");
    // The same check of a program that shares the node's network finds more than a loopback, or another listener.
    let mut shared = sh("sleep 1000");
    shared["readiness"] = json!({ "tcp": { "port": outside.port }, "period": "100ms" });
    controller.assign("shared", shared);
    wait_ready(&controller, "shared", true);
}
