//! The executor's side of the socket. Its processes are the task's; its words are the test's.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;

use muster_api::wire::executor::v1 as proto;
use prost::Message;
use proto::TaskState;
use proto::call::Call as Say;
use proto::event::Event as Heard;

use super::agent::Agent;
use super::until;

/// A connection of an executor that has registered.
pub struct Executor {
    stream: UnixStream,
    sequence: u64,
    /// Id and name of its framework, as it was told.
    pub framework: (String, String),
}

impl Executor {
    /// Connects to the socket of the task `uid`, once it listens.
    #[track_caller]
    pub fn dial(agent: &Agent, uid: &str) -> Executor {
        let socket = agent.task_dir(uid).join("executor/socket");
        let stream = until("an executor's socket", || UnixStream::connect(&socket).ok());
        stream.set_read_timeout(Some(super::PATIENCE)).unwrap();
        Executor { stream, sequence: 0, framework: Default::default() }
    }

    pub fn show(&mut self, token: &str, works: &[&str]) {
        self.say(Say::Register(proto::Register {
            token: token.to_owned(),
            tasks: works.iter().map(|work| (*work).to_owned()).collect(),
            unacknowledged: Vec::new(),
        }));
    }

    /// Connects as the executor of the task `uid`.
    #[track_caller]
    pub fn register(agent: &Agent, uid: &str, works: &[&str]) -> Executor {
        let mut executor = Executor::dial(agent, uid);
        let record = std::fs::read(agent.task_dir(uid).join("task.json")).unwrap();
        let record: serde_json::Value = serde_json::from_slice(&record).unwrap();
        executor.show(record["token"].as_str().unwrap(), works);
        let Heard::Registered(greeting) = executor.hear() else { panic!("no greeting") };
        assert_eq!((greeting.executor.as_str(), greeting.node.as_str()), (uid, "robot-1"));
        executor.framework = (greeting.framework_id, greeting.framework);
        executor
    }

    /// Goes on with the sequence of an earlier connection.
    pub fn after(mut self, before: &Executor) -> Executor {
        self.sequence = before.sequence;
        self
    }

    pub fn say(&mut self, call: Say) {
        let bytes = proto::Call { call: Some(call) }.encode_to_vec();
        self.stream.write_all(&u32::try_from(bytes.len()).unwrap().to_be_bytes()).unwrap();
        self.stream.write_all(&bytes).unwrap();
    }

    #[track_caller]
    pub fn hear(&mut self) -> Heard {
        let mut length = [0; 4];
        self.stream.read_exact(&mut length).unwrap();
        let mut bytes = vec![0; usize::try_from(u32::from_be_bytes(length)).unwrap()];
        self.stream.read_exact(&mut bytes).unwrap();
        proto::Event::decode(bytes.as_slice()).unwrap().event.unwrap()
    }

    #[track_caller]
    pub fn launched(&mut self) -> proto::Launch {
        match self.hear() {
            Heard::Launch(launch) => launch,
            other => panic!("no launch: {other:?}"),
        }
    }

    /// Says so many updates without reading an answer; how many were taken before nobody read them any more.
    pub fn flood(&mut self, work: &str, most: u64) -> u64 {
        self.stream.set_write_timeout(Some(std::time::Duration::from_secs(2))).unwrap();
        for said in 0..most {
            let update = proto::StatusUpdate {
                task: work.to_owned(),
                sequence: self.sequence + said + 1,
                state: TaskState::Running.into(),
                ..proto::StatusUpdate::default()
            };
            let call = proto::Call { call: Some(Say::StatusUpdate(update)) };
            let mut bytes = Vec::new();
            let length = u32::try_from(call.encoded_len()).unwrap();
            bytes.extend_from_slice(&length.to_be_bytes());
            call.encode(&mut bytes).unwrap();
            if self.stream.write_all(&bytes).is_err() {
                return said;
            }
        }
        most
    }

    /// Says it, and waits until the agent has it on its disk.
    #[track_caller]
    pub fn update(&mut self, work: &str, state: proto::TaskState) {
        self.sequence += 1;
        self.say(Say::StatusUpdate(proto::StatusUpdate {
            task: work.to_owned(),
            sequence: self.sequence,
            state: state.into(),
            message: format!("{work} says so"),
            exit_code: (state == proto::TaskState::Failed).then_some(7),
        }));
        let Heard::Acknowledged(ack) = self.hear() else { panic!("no acknowledgement") };
        assert_eq!(ack.sequence, self.sequence);
    }

    /// Whether the agent has closed the connection.
    pub fn is_closed(&mut self) -> bool {
        match self.stream.read(&mut [0]) {
            Ok(read) => read == 0,
            Err(error) => error.kind() == std::io::ErrorKind::ConnectionReset,
        }
    }
}
