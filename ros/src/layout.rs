//! A message type that is known only when the program runs: what its messages look like, read from its definition.
//!
//! Made of JSON with the fields' names; a field that is not there has ROS's value of nothing (`0`, an empty text), one that the
//! type does not have is an error, and so is a number that does not fit. `time` and `duration` are `{"secs": …, "nsecs": …}`.

use std::collections::BTreeMap;

use bytes::Bytes;
use serde_json::Value;

use crate::message::Description;
use crate::time::{Duration, Time};
use crate::wire::{DecodeError, Reader, Wire};

/// What the messages of a type look like.
#[derive(Debug, Clone)]
pub struct Layout {
    of: Description,
    /// This type's and those of the messages in it.
    types: BTreeMap<String, Vec<Field>>,
}

#[derive(Debug, Clone)]
struct Field {
    name: String,
    base: Base,
    shape: Shape,
}

#[derive(Debug, Clone, Copy)]
enum Shape {
    One,
    Many,
    Fixed(usize),
}

#[derive(Debug, Clone)]
enum Base {
    Bool,
    Int8,
    Uint8,
    Int16,
    Uint16,
    Int32,
    Uint32,
    Int64,
    Uint64,
    Float32,
    Float64,
    Text,
    Time,
    Duration,
    Message(String),
}

/// Why JSON is no message of a type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LayoutError {
    /// The type has no such field.
    #[error("{of} has no field {field:?}; it has {known}")]
    NoField {
        /// The type of the message that it is in.
        of: String,
        /// As it is written.
        field: String,
        /// Those that there are.
        known: String,
    },
    /// A value is of another kind, or does not fit.
    #[error("{field} must be {wanted}")]
    Value {
        /// From the message down, `linear.x`.
        field: String,
        /// What it must be.
        wanted: String,
    },
}

impl Layout {
    /// Of a type that is known here.
    #[must_use]
    pub fn of(description: &Description) -> Layout {
        let mut types = BTreeMap::new();
        let mut name = description.name.to_owned();
        let mut fields = Vec::new();
        for line in description.definition.lines() {
            if let Some(next) = line.strip_prefix("MSG: ") {
                types.insert(std::mem::replace(&mut name, next.trim().to_owned()), fields);
                fields = Vec::new();
            } else {
                fields.extend(field(line, &name));
            }
        }
        types.insert(name, fields);
        Layout { of: *description, types }
    }

    /// The type.
    #[must_use]
    pub fn description(&self) -> &Description {
        &self.of
    }

    /// The serialised message that JSON describes.
    ///
    /// # Errors
    ///
    /// Names the field.
    pub fn encode(&self, json: &Value) -> Result<Vec<u8>, LayoutError> {
        let mut to = Vec::new();
        self.write(self.of.name, Some(json), &mut String::new(), &mut to)?;
        Ok(to)
    }

    /// Whether a body is a message of the type, whole.
    ///
    /// # Errors
    ///
    /// It is none.
    pub fn check(&self, body: &Bytes) -> Result<(), DecodeError> {
        let mut from = Reader::new(body.clone());
        self.pass(self.of.name, &mut from)?;
        from.finish()
    }

    fn fields(&self, of: &str) -> &[Field] {
        self.types.get(of).map_or(&[], Vec::as_slice)
    }

    fn write(
        &self,
        of: &str,
        json: Option<&Value>,
        path: &mut String,
        to: &mut Vec<u8>,
    ) -> Result<(), LayoutError> {
        let members = match json {
            None => None,
            Some(Value::Object(members)) => Some(members),
            Some(_) => return Err(value_error(path, &format!("an object, {of}"))),
        };
        let fields = self.fields(of);
        let unknown = |name: &&String| fields.iter().all(|field| field.name != **name);
        if let Some(name) = members.and_then(|members| members.keys().find(unknown)) {
            let known: Vec<&str> = fields.iter().map(|field| &*field.name).collect();
            let (of, field) = (of.to_owned(), name.clone());
            return Err(LayoutError::NoField { of, field, known: known.join(", ") });
        }
        for field in fields {
            let json = members.and_then(|members| members.get(&field.name));
            let length = path.len();
            if !path.is_empty() {
                path.push('.');
            }
            path.push_str(&field.name);
            self.write_field(field, json, path, to)?;
            path.truncate(length);
        }
        Ok(())
    }

    fn write_field(
        &self,
        field: &Field,
        json: Option<&Value>,
        path: &mut String,
        to: &mut Vec<u8>,
    ) -> Result<(), LayoutError> {
        let list = |wanted: &str| match json {
            None => Ok(None),
            Some(Value::Array(values)) => Ok(Some(values)),
            Some(_) => Err(value_error(path, wanted)),
        };
        match field.shape {
            Shape::One => self.write_one(&field.base, json, path, to),
            Shape::Many => {
                let values = list("an array")?.map_or(&[][..], Vec::as_slice);
                let count = u32::try_from(values.len());
                count.map_err(|_| value_error(path, "shorter"))?.write(to);
                values.iter().try_for_each(|one| self.write_one(&field.base, Some(one), path, to))
            }
            Shape::Fixed(size) => {
                let wanted = format!("an array of {size}");
                let values = list(&wanted)?;
                if values.is_some_and(|values| values.len() != size) {
                    return Err(value_error(path, &wanted));
                }
                let one = |at: usize| values.and_then(|values| values.get(at));
                (0..size).try_for_each(|at| self.write_one(&field.base, one(at), path, to))
            }
        }
    }

    fn write_one(
        &self,
        base: &Base,
        json: Option<&Value>,
        path: &mut String,
        to: &mut Vec<u8>,
    ) -> Result<(), LayoutError> {
        let written = match base {
            Base::Message(of) => return self.write(of, json, path, to),
            Base::Bool => put(json, Value::as_bool, "true or false", to),
            Base::Int8 => integer::<i8>(json, to),
            Base::Uint8 => integer::<u8>(json, to),
            Base::Int16 => integer::<i16>(json, to),
            Base::Uint16 => integer::<u16>(json, to),
            Base::Int32 => integer::<i32>(json, to),
            Base::Uint32 => integer::<u32>(json, to),
            Base::Int64 => integer::<i64>(json, to),
            Base::Uint64 => integer::<u64>(json, to),
            Base::Float32 => put(json, float32, "a number that a float32 can be", to),
            Base::Float64 => put(json, Value::as_f64, "a number", to),
            Base::Text => put(json, |v| v.as_str().map(str::to_owned), "a text", to),
            Base::Time => put(json, time, "{\"secs\": …, \"nsecs\": …}", to),
            Base::Duration => put(json, duration, "{\"secs\": …, \"nsecs\": …}", to),
        };
        written.map_err(|wanted| value_error(path, &wanted))
    }

    fn pass(&self, of: &str, from: &mut Reader) -> Result<(), DecodeError> {
        for field in self.fields(of) {
            let count = match field.shape {
                Shape::One => 1,
                Shape::Fixed(size) => size,
                Shape::Many => from.count(1)?,
            };
            for _ in 0..count {
                self.pass_one(&field.base, from)?;
            }
        }
        Ok(())
    }

    fn pass_one(&self, base: &Base, from: &mut Reader) -> Result<(), DecodeError> {
        let size = match base {
            Base::Message(of) => return self.pass(of, from),
            Base::Text => return String::read(from).map(drop),
            Base::Bool | Base::Int8 | Base::Uint8 => 1,
            Base::Int16 | Base::Uint16 => 2,
            Base::Int32 | Base::Uint32 | Base::Float32 => 4,
            Base::Int64 | Base::Uint64 | Base::Float64 | Base::Time | Base::Duration => 8,
        };
        from.take(size).map(drop)
    }
}

fn value_error(path: &str, wanted: &str) -> LayoutError {
    let field = if path.is_empty() { "the message" } else { path };
    LayoutError::Value { field: field.to_owned(), wanted: wanted.to_owned() }
}

/// Writes what `read` makes of the JSON, or nothing's value when there is none.
fn put<T: Wire>(
    json: Option<&Value>,
    read: impl FnOnce(&Value) -> Option<T>,
    wanted: &str,
    to: &mut Vec<u8>,
) -> Result<(), String> {
    let value = match json {
        Some(json) => read(json).ok_or_else(|| wanted.to_owned())?,
        None => T::nothing(),
    };
    value.write(to);
    Ok(())
}

fn integer<T: Wire + TryFrom<i128>>(json: Option<&Value>, to: &mut Vec<u8>) -> Result<(), String> {
    let read = |json: &Value| {
        let wide = json.as_i64().map(i128::from).or_else(|| json.as_u64().map(i128::from));
        wide.and_then(|wide| T::try_from(wide).ok())
    };
    put(json, read, &format!("an integer of {} bits", T::LEAST * 8), to)
}

fn float32(json: &Value) -> Option<f32> {
    let narrow = json.as_f64()? as f32;
    narrow.is_finite().then_some(narrow)
}

/// Seconds and nanoseconds, and nothing else.
fn instant(json: &Value) -> Option<(&Value, &Value)> {
    let members = json.as_object().filter(|members| members.len() == 2)?;
    Some((members.get("secs")?, members.get("nsecs")?))
}

fn time(json: &Value) -> Option<Time> {
    let (sec, nsec) = instant(json)?;
    Some(Time {
        sec: u32::try_from(sec.as_u64()?).ok()?,
        nsec: u32::try_from(nsec.as_u64()?).ok()?,
    })
}

fn duration(json: &Value) -> Option<Duration> {
    let (sec, nsec) = instant(json)?;
    Some(Duration {
        sec: i32::try_from(sec.as_i64()?).ok()?,
        nsec: i32::try_from(nsec.as_i64()?).ok()?,
    })
}

/// The field of a line; none: it is empty, a comment, or a constant. `within` is the type that it stands in.
fn field(line: &str, within: &str) -> Option<Field> {
    let line = line.split('#').next().unwrap_or_default().trim();
    if line.contains('=') {
        return None;
    }
    let (kind, name) = line.split_once(char::is_whitespace)?;
    let (base, shape) = match kind.strip_suffix(']').and_then(|kind| kind.split_once('[')) {
        None => (kind, Shape::One),
        Some((base, "")) => (base, Shape::Many),
        Some((base, size)) => (base, Shape::Fixed(size.parse().ok()?)),
    };
    Some(Field { name: name.trim().to_owned(), base: self::base(base, within), shape })
}

fn base(name: &str, within: &str) -> Base {
    match name {
        "bool" => Base::Bool,
        "int8" | "byte" => Base::Int8,
        "uint8" | "char" => Base::Uint8,
        "int16" => Base::Int16,
        "uint16" => Base::Uint16,
        "int32" => Base::Int32,
        "uint32" => Base::Uint32,
        "int64" => Base::Int64,
        "uint64" => Base::Uint64,
        "float32" => Base::Float32,
        "float64" => Base::Float64,
        "string" => Base::Text,
        "time" => Base::Time,
        "duration" => Base::Duration,
        "Header" => Base::Message("std_msgs/Header".to_owned()),
        whole if whole.contains('/') => Base::Message(whole.to_owned()),
        short => {
            let package = within.split('/').next().unwrap_or_default();
            Base::Message(format!("{package}/{short}"))
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use crate::message::{Message, describe};
    use crate::wire::sample::{Entropy, Sample};
    use crate::{ALL, geometry_msgs, nav_msgs, sensor_msgs, std_msgs, tf2_msgs};

    fn layout<M: Message>() -> Layout {
        Layout::of(&describe::<M>())
    }

    #[test]
    fn nothing_is_the_same_as_the_generated_default_of_every_type() {
        for description in ALL {
            let layout = Layout::of(description);
            let nothing = Bytes::from(layout.encode(&json!({})).unwrap());
            assert_eq!(layout.check(&nothing), Ok(()), "{}", description.name);
            let long = Bytes::from([&*nothing, &[0]].concat());
            assert_eq!(layout.check(&long), Err(DecodeError::Long(1)), "{}", description.name);
        }
        let same = |layout: Layout, bytes: Vec<u8>| {
            assert_eq!(layout.encode(&json!({})).unwrap(), bytes, "{}", layout.of.name);
        };
        same(layout::<nav_msgs::Odometry>(), nav_msgs::Odometry::default().encode());
        same(layout::<sensor_msgs::BatteryState>(), sensor_msgs::BatteryState::default().encode());
        same(layout::<sensor_msgs::CameraInfo>(), sensor_msgs::CameraInfo::default().encode());
    }

    #[test]
    fn json_becomes_the_message_that_it_describes() {
        let twist = json!({"linear": {"x": 0.5}, "angular": {"z": -1}});
        let of = |x, z| geometry_msgs::Vector3 { x, y: 0.0, z };
        let wanted = geometry_msgs::Twist { linear: of(0.5, 0.0), angular: of(0.0, -1.0) };
        assert_eq!(layout::<geometry_msgs::Twist>().encode(&twist).unwrap(), wanted.encode());
        let state = json!({
            "header": {"seq": 4_294_967_295u32, "stamp": {"secs": 5, "nsecs": 7}, "frame_id": "ä"},
            "name": ["a", "b"], "position": [1.5, 2],
        });
        let wanted = sensor_msgs::JointState {
            header: std_msgs::Header {
                seq: u32::MAX,
                stamp: Time { sec: 5, nsec: 7 },
                frame_id: "ä".to_owned(),
            },
            name: vec!["a".to_owned(), "b".to_owned()],
            position: vec![1.5, 2.0],
            ..Default::default()
        };
        assert_eq!(layout::<sensor_msgs::JointState>().encode(&state).unwrap(), wanted.encode());
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let twist = layout::<geometry_msgs::Twist>();
        let cases = [
            (
                json!({"linaer": {}}),
                "geometry_msgs/Twist has no field \"linaer\"; it has linear, angular",
            ),
            (json!({"linear": {"w": 1}}), "geometry_msgs/Vector3 has no field \"w\""),
            (json!({"linear": {"x": "fast"}}), "linear.x must be a number"),
            (json!({"linear": 1}), "linear must be an object, geometry_msgs/Vector3"),
            (json!([]), "the message must be an object"),
        ];
        for (json, words) in cases {
            let error = twist.encode(&json).unwrap_err().to_string();
            assert!(error.contains(words), "{json}: {error}");
        }
        for (json, words) in [
            (json!({"data": 128}), "data must be an integer of 8 bits"),
            (json!({"data": 1.5}), "data must be an integer"),
        ] {
            let error = layout::<std_msgs::Int8>().encode(&json).unwrap_err().to_string();
            assert!(error.contains(words), "{json}: {error}");
        }
        let pose = layout::<geometry_msgs::PoseWithCovariance>();
        let error = pose.encode(&json!({"covariance": [1]})).unwrap_err().to_string();
        assert_eq!(error, "covariance must be an array of 36");
    }

    fn agrees<M: Message + Sample>(entropy: &[u8], body: &Bytes) {
        let layout = layout::<M>();
        let message = Bytes::from(M::sample(&mut Entropy::new(entropy.to_vec())).encode());
        assert_eq!(layout.check(&message), Ok(()), "{}", M::TYPE);
        assert_eq!(layout.check(body).is_ok(), M::decode(body.clone()).is_ok(), "{}", M::TYPE);
    }

    proptest! {
        /// What the generated code takes is taken, and nothing else.
        #[test]
        fn bodies_are_checked_as_they_are_decoded(
            entropy in prop::collection::vec(any::<u8>(), 0..300),
            body in prop::collection::vec(any::<u8>(), 0..100),
        ) {
            let body = Bytes::from(body);
            agrees::<geometry_msgs::Twist>(&entropy, &body);
            agrees::<std_msgs::String>(&entropy, &body);
            agrees::<std_msgs::Header>(&entropy, &body);
            agrees::<sensor_msgs::JointState>(&entropy, &body);
            agrees::<tf2_msgs::TFMessage>(&entropy, &body);
        }
    }
}
