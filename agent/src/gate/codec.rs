//! How a command becomes what a driver reads: a frame among others, or a message of a topic's type.

use bytes::{BufMut as _, Bytes, BytesMut};
use muster_ros1::layout::Layout;

use super::settings::{self, Framing};

/// How a command becomes what the driver reads.
#[derive(Debug)]
pub(super) enum Codec {
    Bytes(Framing),
    /// None: the type is not known.
    Topic(Option<Layout>),
}

impl Codec {
    pub(super) fn of(settings: &settings::Driver) -> Codec {
        match &settings.ros1 {
            Some(topic) => Codec::Topic(topic.layout()),
            None => Codec::Bytes(settings.framing),
        }
    }

    /// `format`: empty, or of a topic `ros1:TYPE` when the message is serialised. `None`: it is nothing for this driver.
    pub(super) fn encode(&self, format: &str, data: &[u8]) -> Option<Bytes> {
        match (self, format) {
            (Codec::Bytes(framing), "") => framed(*framing, data),
            (Codec::Topic(Some(layout)), "") => {
                let json = serde_json::from_slice(data).ok()?;
                layout.encode(&json).ok().map(Bytes::from)
            }
            (Codec::Topic(Some(layout)), format) => {
                let body = Bytes::copy_from_slice(data);
                let is = format.strip_prefix("ros1:")? == layout.description().name;
                (is && layout.check(&body).is_ok()).then_some(body)
            }
            (Codec::Bytes(_) | Codec::Topic(None), _) => None,
        }
    }
}

/// `None`: it cannot be kept apart from the next one.
fn framed(framing: Framing, data: &[u8]) -> Option<Bytes> {
    let mut frame = BytesMut::with_capacity(data.len() + 4);
    match framing {
        Framing::Lines if data.contains(&b'\n') => return None,
        Framing::Lines => {
            frame.put_slice(data);
            frame.put_u8(b'\n');
        }
        Framing::Length => {
            frame.put_u32(u32::try_from(data.len()).ok()?);
            frame.put_slice(data);
        }
    }
    Some(frame.freeze())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topics_commands_are_json_or_serialised() {
        let settings = serde_json::json!({
            "actuators": ["base:Drive"], "ros1": {"topic": "/go", "type": "std_msgs/Float64"},
        });
        let codec = Codec::of(&serde_json::from_value(settings).unwrap());
        let two = Bytes::copy_from_slice(&2f64.to_le_bytes());
        assert_eq!(codec.encode("", br#"{"data": 2}"#).as_ref(), Some(&two));
        assert_eq!(codec.encode("ros1:std_msgs/Float64", &two).as_ref(), Some(&two));
        for (format, data) in [
            ("", &br#"{"date": 2}"#[..]),
            ("", b"2"),
            ("", &two),
            ("ros1:std_msgs/Float64", b"short"),
            ("ros1:std_msgs/Int64", &two),
            ("std_msgs/Float64", &two),
        ] {
            assert_eq!(codec.encode(format, data), None, "{format} {data:?}");
        }
        assert_eq!(Codec::Bytes(Framing::Lines).encode("ros1:std_msgs/Float64", b"go"), None);
    }

    #[test]
    fn frames() {
        assert_eq!(framed(Framing::Lines, b"go").unwrap(), "go\n");
        assert_eq!(framed(Framing::Lines, b"go\non"), None);
        assert_eq!(framed(Framing::Length, b"a\n").unwrap().as_ref(), b"\0\0\0\x02a\n");
    }
}
