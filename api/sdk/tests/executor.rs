//! Executors against an agent that does what the test tells it.

use std::time::Duration;

use bytes::{BufMut as _, Bytes, BytesMut};
use muster_api::wire::executor::v1 as proto;
use muster_api::wire::framework_session::struct_of;
use muster_sdk::executor::{
    Executor, ExecutorDriver, ExecutorHandle, Registration, Status, Task, TaskState,
};
use prost::Message as _;
use proto::call::Call as Say;
use proto::event::Event as Tell;
use serde_json::json;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::mpsc;
use tokio_util::task::AbortOnDropHandle;

async fn soon<F: Future>(what: F) -> F::Output {
    tokio::time::timeout(Duration::from_secs(60), what).await.expect("in time")
}

/// The agent's end of one connection.
struct Connection(UnixStream);

impl Connection {
    async fn accept(listener: &UnixListener) -> Self {
        Connection(soon(listener.accept()).await.expect("a connection").0)
    }

    async fn hear(&mut self) -> Say {
        let length = soon(self.0.read_u32()).await.expect("a length");
        let mut frame = vec![0; length as usize];
        soon(self.0.read_exact(&mut frame)).await.expect("a frame");
        proto::Call::decode(&*frame).expect("a call").call.expect("a call")
    }

    async fn register(&mut self) -> proto::Register {
        let Say::Register(register) = self.hear().await else { panic!("no Register") };
        let registered = proto::Registered {
            executor: "e1".to_owned(),
            namespace: "team".to_owned(),
            framework: "deliver".to_owned(),
            framework_id: "f1".to_owned(),
            node: "tb1".to_owned(),
            reregistered: !register.tasks.is_empty(),
        };
        self.say(Tell::Registered(registered)).await;
        register
    }

    async fn update(&mut self) -> (u64, TaskState) {
        let Say::StatusUpdate(update) = self.hear().await else { panic!("no update") };
        (update.sequence, update.state())
    }

    async fn say(&mut self, event: Tell) {
        let message = proto::Event { event: Some(event) }.encode_to_vec();
        let mut frame = BytesMut::new();
        frame.put_u32(u32::try_from(message.len()).expect("short"));
        frame.extend_from_slice(&message);
        soon(self.0.write_all(&frame)).await.expect("connected");
    }

    async fn acknowledge(&mut self, sequence: u64) {
        self.say(Tell::Acknowledged(proto::Acknowledged { sequence })).await;
    }

    async fn launch(&mut self, task: &str) {
        let data = json!({"goal": [1, 2]});
        let launch = proto::Launch {
            task: task.to_owned(),
            name: "go".to_owned(),
            data: data.as_object().map(struct_of),
            lease: Some(proto::Lease {
                node: "tb1".into(),
                group: "body".into(),
                epoch: 4,
                gate_token: String::new(),
            }),
        };
        self.say(Tell::Launch(launch)).await;
    }
}

/// Runs every task until it is killed, and passes on what it is called back with.
struct Runner(mpsc::UnboundedSender<String>);

impl Runner {
    fn note(&self, what: String) {
        self.0.send(what).expect("a test");
    }
}

impl Executor for Runner {
    async fn registered(&mut self, _: &ExecutorHandle, registration: Registration) {
        self.note(format!(
            "registered for {} {}",
            registration.framework, registration.framework_id
        ));
    }

    async fn reregistered(&mut self, _: &ExecutorHandle) {
        self.note("reregistered".to_owned());
    }

    async fn disconnected(&mut self, handle: &ExecutorHandle) {
        let status = Status::new("b", TaskState::Failed).message("while away").exit_code(3);
        handle.send_status_update(status).await.expect("running");
        self.note("disconnected".to_owned());
    }

    async fn launch_task(&mut self, handle: &ExecutorHandle, task: Task) {
        self.note(format!(
            "launch {} {} {:?}",
            task.uid,
            task.data["goal"],
            task.lease.map(|l| l.epoch)
        ));
        let status = Status::new(task.uid, TaskState::Running);
        handle.send_status_update(status).await.expect("running");
    }

    async fn kill_task(&mut self, handle: &ExecutorHandle, task: &str, grace: Duration) {
        self.note(format!("kill {task} in {grace:?}"));
        let status = Status::new(task, TaskState::Killed);
        handle.send_status_update(status).await.expect("running");
    }

    async fn framework_message(&mut self, handle: &ExecutorHandle, data: Bytes) {
        handle.send_framework_message(data).await.expect("running");
    }

    async fn shutdown(&mut self, handle: &ExecutorHandle, _: Duration) {
        let status = Status::new("a", TaskState::Killed);
        handle.send_status_update(status).await.expect("running");
    }
}

struct Agent {
    dir: tempfile::TempDir,
    listener: UnixListener,
    notes: mpsc::UnboundedReceiver<String>,
    driver: AbortOnDropHandle<()>,
}

impl Agent {
    fn start() -> Self {
        let dir = tempfile::tempdir().expect("a directory");
        let socket = dir.path().join("socket");
        let listener = UnixListener::bind(&socket).expect("bound");
        let (note, notes) = mpsc::unbounded_channel();
        let driver = tokio::spawn(ExecutorDriver::new(socket, "secret").run(Runner(note)));
        Agent { dir, listener, notes, driver: AbortOnDropHandle::new(driver) }
    }

    async fn note(&mut self) -> String {
        soon(self.notes.recv()).await.expect("a note")
    }
}

#[tokio::test]
async fn tasks_are_launched_killed_and_shut_down() {
    let mut agent = Agent::start();
    let mut connection = Connection::accept(&agent.listener).await;
    let register = connection.register().await;
    assert_eq!((register.token.as_str(), register.tasks.len()), ("secret", 0));
    assert_eq!(agent.note().await, "registered for deliver f1");
    for task in ["a", "b"] {
        connection.launch(task).await;
        assert_eq!(agent.note().await, format!("launch {task} [1,2] Some(4)"));
        let (sequence, state) = connection.update().await;
        assert_eq!(state, TaskState::Running);
        connection.acknowledge(sequence).await;
    }
    // Said again by an agent that does not know whether it was heard.
    connection.launch("a").await;
    connection.say(Tell::Kill(proto::Kill { task: "b".into(), grace_period_ms: 1500 })).await;
    assert_eq!(agent.note().await, "kill b in 1.5s");
    assert_eq!(connection.update().await, (3, TaskState::Killed));
    let data = Bytes::from(vec![7; 4 << 20]);
    connection.say(Tell::Message(proto::Message { data: data.clone() })).await;
    let Say::Message(back) = connection.hear().await else { panic!("no message") };
    assert!(back.data == data);
    connection.say(Tell::Shutdown(proto::Shutdown { grace_period_ms: 60_000 })).await;
    assert_eq!(connection.update().await, (4, TaskState::Killed));
    // It ends when the agent has everything, and not before.
    connection.acknowledge(4).await;
    assert!(!agent.driver.is_finished());
    connection.acknowledge(3).await;
    soon(&mut agent.driver).await.expect("no panic");
}

#[tokio::test]
async fn an_agent_that_comes_back_is_told_what_it_missed() {
    let mut agent = Agent::start();
    let mut connection = Connection::accept(&agent.listener).await;
    connection.register().await;
    assert_eq!(agent.note().await, "registered for deliver f1");
    for (task, sequence) in [("a", 1), ("b", 2)] {
        connection.launch(task).await;
        agent.note().await;
        assert_eq!(connection.update().await, (sequence, TaskState::Running));
    }
    connection.acknowledge(1).await;
    // A message that comes back shows that the acknowledgement was heard.
    connection.say(Tell::Message(proto::Message { data: Bytes::from_static(b"x") })).await;
    assert!(matches!(connection.hear().await, Say::Message(_)));
    // The agent ends, socket and all, and begins anew when the executor has seen it.
    std::fs::remove_file(agent.dir.path().join("socket")).expect("removed");
    drop(connection);
    assert_eq!(agent.note().await, "disconnected");
    agent.listener = UnixListener::bind(agent.dir.path().join("socket")).expect("bound");
    let mut connection = Connection::accept(&agent.listener).await;
    let register = connection.register().await;
    assert_eq!(register.tasks, ["a"], "b ended meanwhile");
    let missed: Vec<_> =
        register.unacknowledged.iter().map(|u| (u.sequence, u.state(), u.exit_code)).collect();
    assert_eq!(missed, [(2, TaskState::Running, None), (3, TaskState::Failed, Some(3))]);
    assert_eq!(agent.note().await, "reregistered");
}

#[test]
fn a_program_that_no_agent_started_is_told_so() {
    let error = ExecutorDriver::from_env().expect_err("not in a test's environment");
    assert!(error.to_string().ends_with("executors are started by the agent"), "{error}");
}
