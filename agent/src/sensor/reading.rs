//! A sensor as a topic of ROS 1, for a task that has a graph of its own: messages of ROS as they came, those of the simulated robot
//! serialised. What a device or a program says is of no type, and no topic.

use std::sync::Arc;

use bytes::Bytes;
use muster_ros1::message::{Type, describe};
use muster_ros1::name::{Resolver, plain};
use muster_ros1::proto::sensor_msgs as proto;
use muster_ros1::sensor_msgs::{Image, LaserScan};
use prost::Message as _;

use super::channel::{Body, Channel, Demand, Subscription};
use super::settings::Simulated;

/// A function, and the topic's global name.
#[derive(Debug, Clone)]
pub(crate) struct Topic {
    name: String,
    channel: Arc<Channel>,
}

/// A message, serialised.
#[derive(Debug)]
pub(crate) struct Message {
    pub(crate) of: Arc<Type>,
    pub(crate) body: Bytes,
}

/// What a sensor says. While it is there, the sensor is read.
#[derive(Debug)]
pub(crate) struct Reading {
    channel: Arc<Channel>,
    subscription: Subscription,
    _demand: Demand,
}

impl Topic {
    /// None: it says nothing that ROS has a type for. A ROS source keeps its topic's name, relative ones in `namespace`.
    pub(super) fn of(channel: &Arc<Channel>, namespace: &str) -> Option<Topic> {
        let settings = channel.settings();
        let name = match (&settings.ros1, settings.sim) {
            (Some(topic), _) => {
                Resolver::new(namespace, "agent", []).and_then(|names| names.resolve(topic)).ok()?
            }
            (None, Some(_)) => {
                let path = channel.function().path();
                let path: Vec<String> = path.split('/').map(plain).collect();
                let names = Resolver::new("/", "agent", []);
                names.and_then(|names| names.resolve(&path.join("/"))).ok()?
            }
            (None, None) => return None,
        };
        Some(Topic { name, channel: Arc::clone(channel) })
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    pub(crate) fn read(&self) -> Reading {
        let channel = Arc::clone(&self.channel);
        let (subscription, _demand) = (channel.subscribe(1), channel.want());
        Reading { channel, subscription, _demand }
    }
}

impl Reading {
    /// The next message. What is none is passed over.
    pub(crate) async fn next(&mut self) -> Message {
        loop {
            let Ok(delivery) = self.subscription.next().await else {
                // It was put out, for it kept a frame while memory ran out.
                self.subscription = self.channel.subscribe(1);
                continue;
            };
            let body = match &delivery.frame.body {
                Body::Inline(bytes) => bytes.clone(),
                Body::Shared { slot, length } => Bytes::copy_from_slice(slot.bytes(*length)),
            };
            let message = self.message(body);
            // It is this subscription's own, and was not given back before.
            let _ = self.subscription.done(delivery.sequence);
            if let Some(message) = message {
                return message;
            }
        }
    }

    fn message(&self, body: Bytes) -> Option<Message> {
        match self.channel.settings().sim {
            None => Some(Message { of: self.channel.kind()?, body }),
            Some(Simulated::Laser) => {
                let scan = LaserScan::try_from(&proto::LaserScan::decode(body).ok()?).ok()?;
                Some(serialised(&scan))
            }
            Some(Simulated::Camera) => {
                let image = Image::try_from(&proto::Image::decode(body).ok()?).ok()?;
                Some(serialised(&image))
            }
        }
    }
}

fn serialised<M: muster_ros1::Message>(message: &M) -> Message {
    let mut body = Vec::new();
    message.write(&mut body);
    Message { of: Arc::new(describe::<M>().into()), body: body.into() }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt as _;
    use serde_json::{Value, json};

    use super::*;

    fn topic(settings: Value) -> Option<Topic> {
        let channel = Arc::new(Channel::new(serde_json::from_value(settings).unwrap()));
        Topic::of(&channel, "/r1")
    }

    #[test]
    fn a_ros_source_keeps_its_name_and_what_has_no_type_is_no_topic() {
        let name = |source: Value| topic(source).map(|topic| topic.name().to_owned());
        assert_eq!(name(json!({"function": "k:I", "ros1": "/image"})).unwrap(), "/image");
        assert_eq!(name(json!({"function": "k:I", "ros1": "image"})).unwrap(), "/r1/image");
        assert_eq!(name(json!({"function": "k-1:L", "sim": "Laser"})).unwrap(), "/k_1/L");
        assert_eq!(name(json!({"function": "k:L", "exec": ["x"], "framing": "Lines"})), None);
    }

    #[test]
    fn what_the_simulated_robot_says_is_serialised_and_what_is_no_scan_is_passed_over() {
        let topic = topic(json!({"function": "k:L", "sim": "Laser"})).unwrap();
        let mut reading = topic.read();
        let scan = LaserScan { ranges: vec![1.0, 2.5], ..LaserScan::default() };
        for body in [b"no scan".to_vec(), proto::LaserScan::from(&scan).encode_to_vec()] {
            let mut blank = topic.channel.blank(body.len()).unwrap();
            blank.bytes().copy_from_slice(&body);
            topic.channel.publish(blank);
            let read = reading.next().now_or_never();
            let Some(message) = read else {
                assert_eq!(body, b"no scan");
                continue;
            };
            assert_eq!(message.of.name, "sensor_msgs/LaserScan");
            assert_eq!(<LaserScan as muster_ros1::Message>::decode(message.body).unwrap(), scan);
        }
    }
}
