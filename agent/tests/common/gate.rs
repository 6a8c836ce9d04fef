//! Whoever commands a robot's actuators, by the gate's socket; and what the driver heard of it.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};

use muster_api::wire::gate::v1 as proto;
use prost::Message;
use proto::call::Call as Say;
use proto::event::Event as Heard;

use super::agent::Agent;
use super::until;

/// A connection that has registered.
pub struct Holder {
    stream: UnixStream,
    id: u64,
    /// Who the gate takes it for.
    pub task: String,
}

/// A frame as it is on the wire.
pub fn frame(call: Say) -> Vec<u8> {
    let bytes = proto::Call { call: Some(call) }.encode_to_vec();
    [&u32::try_from(bytes.len()).unwrap().to_be_bytes()[..], &bytes].concat()
}

/// The frame that says who a task is.
pub fn register(agent: &Agent, uid: &str) -> Vec<u8> {
    let record = std::fs::read(agent.task_dir(uid).join("task.json")).unwrap();
    let record: serde_json::Value = serde_json::from_slice(&record).unwrap();
    frame(Say::Register(proto::Register { token: record["token"].as_str().unwrap().to_owned() }))
}

/// A command of `epoch[,number…]`.
pub fn command(id: u64, lease: &str, data: &str) -> Say {
    Say::Command(proto::Command {
        id,
        lease: Some(self::lease(lease)),
        actuator: "base:Drive".to_owned(),
        data: data.to_owned().into(),
        ..Default::default()
    })
}

fn lease(text: &str) -> proto::Lease {
    let mut numbers = text.split(',');
    let epoch = numbers.next().unwrap().parse().unwrap();
    proto::Lease { epoch, sequence: numbers.map(|n| n.parse().unwrap()).collect() }
}

pub fn socket(agent: &Agent) -> PathBuf {
    agent.dir.path().join("gate/tasks/socket")
}

impl Holder {
    /// Connects with the bytes of a first frame; `None`: it was put out.
    pub fn show(socket: &Path, first: &[u8]) -> Option<Holder> {
        let stream = until("the gate's socket", || UnixStream::connect(socket).ok());
        stream.set_read_timeout(Some(super::PATIENCE)).unwrap();
        let mut holder = Holder { stream, id: 0, task: String::new() };
        holder.stream.write_all(first).ok()?;
        match holder.hear()? {
            Heard::Registered(registered) => holder.task = registered.task,
            Heard::Answer(_) => return None,
        }
        Some(holder)
    }

    /// Connects as the task `uid`.
    #[track_caller]
    pub fn register(agent: &Agent, uid: &str) -> Holder {
        let first = register(agent, uid);
        until("the gate to know the task", || Holder::show(&socket(agent), &first))
    }

    pub fn say(&mut self, call: Say) -> Option<()> {
        self.stream.write_all(&frame(call)).ok()
    }

    /// `None`: the gate has closed.
    pub fn hear(&mut self) -> Option<Heard> {
        let mut length = [0; 4];
        self.stream.read_exact(&mut length).ok()?;
        let mut bytes = vec![0; usize::try_from(u32::from_be_bytes(length)).unwrap()];
        self.stream.read_exact(&mut bytes).ok()?;
        proto::Event::decode(bytes.as_slice()).unwrap().event
    }

    fn ask(&mut self, call: Say) -> Option<proto::Answer> {
        self.say(call)?;
        let Heard::Answer(answer) = self.hear()? else { panic!("no answer") };
        assert_eq!(answer.id, self.id);
        Some(answer)
    }

    /// What a command is answered; `None`: the gate has closed.
    pub fn command(&mut self, lease: &str, data: &str) -> Option<proto::Answer> {
        self.id += 1;
        self.ask(command(self.id, lease, data))
    }

    /// The same, with the verdict alone.
    #[track_caller]
    pub fn verdict(&mut self, lease: &str, data: &str) -> proto::Verdict {
        self.command(lease, data).expect("the gate is there").verdict()
    }

    #[track_caller]
    pub fn delegate(&mut self, lease: &str, task: &str) -> proto::Verdict {
        self.id += 1;
        let delegate =
            proto::Delegate { id: self.id, lease: Some(self::lease(lease)), task: task.to_owned() };
        self.ask(Say::Delegate(delegate)).expect("the gate is there").verdict()
    }
}

/// A driver that writes down what it hears.
pub struct Driver {
    pub dir: tempfile::TempDir,
}

impl Driver {
    /// One line a command, in a file; `more` goes into the gate's settings.
    pub fn new(more: &str) -> Driver {
        let dir = tempfile::tempdir().unwrap();
        let driver = Driver { dir };
        driver.settings(more);
        driver
    }

    pub fn settings(&self, more: &str) {
        let log = self.log();
        let text = format!(
            "arRes: base:Drive\ngate:\n  drivers:\n  - actuators: ['base:Drive']\n    exec: [sh, -c, 'exec cat >> {}']\n    stop: stop\n{more}",
            log.display()
        );
        std::fs::write(self.config(), text).unwrap();
    }

    pub fn config(&self) -> PathBuf {
        self.dir.path().join("agent.yaml")
    }

    fn log(&self) -> PathBuf {
        self.dir.path().join("heard")
    }

    /// Everything it has heard.
    pub fn heard(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.log()).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    /// Waits until the last thing that it heard is this.
    #[track_caller]
    pub fn wait(&self, last: &str) {
        until(last, || (self.heard().last()? == last).then_some(()));
    }
}
