//! One topic between a task's graph and the robot: a sensor's frames go in, commands for an actuator go out through the gate.

use std::io;
use std::sync::Arc;

use muster_api::wire::gate::v1 as proto;
use muster_ros1::Node;
use muster_ros1::message::Type;
use muster_ros1::node::{PublishOptions, Publisher, SubscribeOptions};
use proto::call::Call as Say;
use proto::event::Event as Said;
use tokio::net::UnixStream;

use super::{Actuator, Right, Sensor};
use crate::driver::chain;
use crate::executor::frame;

/// The largest command, bytes: the gate's.
const LARGEST: usize = 32 << 10;

/// Commands that wait for the gate's answer to those before.
const QUEUE: usize = 8;

/// Publishes what the sensor says. The topic is there from its first message on, for that says of which type it is.
pub(super) async fn sensor(node: &Node, sensor: &Sensor) -> String {
    let mut reading = sensor.read();
    let mut to: Option<(Arc<Type>, Publisher<bytes::Bytes>)> = None;
    loop {
        let message = reading.next().await;
        to.take_if(|(of, _)| *of != message.of);
        let (_, publisher) = match &mut to {
            Some(to) => to,
            None => {
                let options = PublishOptions { queue: 1, ..PublishOptions::default() };
                match node.advertise_any(sensor.name(), (*message.of).clone(), options) {
                    Ok(publisher) => to.insert((message.of, publisher)),
                    Err(error) => return chain(&error),
                }
            }
        };
        publisher.publish(&message.body);
    }
}

/// Hands what is published to the gate, which asks whether the task may drive.
pub(super) async fn actuator(node: &Node, actuator: &Actuator, right: &Right) -> String {
    let options = SubscribeOptions { queue: QUEUE, largest: LARGEST };
    let mut topic = match node.subscribe_any(&actuator.topic, options) {
        Ok(topic) => topic,
        Err(error) => return chain(&error),
    };
    let mut gate: Option<Gate> = None;
    let mut told = None;
    loop {
        let incoming = topic.next().await;
        let (kind, data) = (format!("ros1:{}", incoming.from.kind), incoming.body);
        let asked = async {
            let gate = match &mut gate {
                Some(gate) => gate,
                None => gate.insert(Gate::connect(right).await?),
            };
            gate.command(&actuator.actuator, kind, data).await
        };
        // A command of another moment is not repeated: the next one finds the next gate.
        let answer = asked.await.map_err(|error| {
            gate = None;
            error.to_string()
        });
        if told.as_ref() != Some(&answer) {
            tracing::info!(topic = actuator.topic, ?answer, "a task's commands at the gate");
            told = Some(answer);
        }
    }
}

/// A connection to the gate. Dropped: the robot stands, if the task drove it.
struct Gate {
    stream: UnixStream,
    lease: proto::Lease,
    id: u64,
}

impl Gate {
    async fn connect(right: &Right) -> io::Result<Gate> {
        let mut stream = UnixStream::connect(&right.socket).await?;
        let register = Say::Register(proto::Register { token: right.token.clone() });
        frame::write(&mut stream, &proto::Call { call: Some(register) }).await?;
        let lease = proto::Lease { epoch: right.epoch, sequence: Vec::new() };
        let mut gate = Gate { stream, lease, id: 0 };
        match gate.hear().await? {
            Said::Registered(_) => Ok(gate),
            Said::Answer(_) => Err(io::ErrorKind::InvalidData.into()),
        }
    }

    async fn command(
        &mut self,
        actuator: &str,
        format: String,
        data: bytes::Bytes,
    ) -> io::Result<proto::Verdict> {
        self.id += 1;
        let (id, lease, actuator) = (self.id, Some(self.lease.clone()), actuator.to_owned());
        let command = Say::Command(proto::Command { id, lease, actuator, data, format });
        frame::write(&mut self.stream, &proto::Call { call: Some(command) }).await?;
        loop {
            match self.hear().await? {
                Said::Answer(answer) if answer.id == id => return Ok(answer.verdict()),
                Said::Answer(_) | Said::Registered(_) => {}
            }
        }
    }

    async fn hear(&mut self) -> io::Result<Said> {
        loop {
            match frame::read::<proto::Event, _>(&mut self.stream).await? {
                Some(proto::Event { event: Some(event) }) => return Ok(event),
                // Something newer than this agent.
                Some(_) => {}
                None => return Err(io::ErrorKind::UnexpectedEof.into()),
            }
        }
    }
}
