//! What makes a struct a message: its type's name and checksum.

use crate::wire::{DecodeError, Reader, Wire};
use bytes::Bytes;

/// A message of a known type.
pub trait Message: Wire + Send + Sync + 'static {
    /// `nav_msgs/Odometry`.
    const TYPE: &'static str;
    /// As `rosmsg md5` gives it: two nodes that agree on it agree on the layout.
    const MD5: &'static str;
    /// The definition with those of all messages in it.
    const DEFINITION: &'static str;

    /// Reads a whole message. Byte arrays of it share the body's memory.
    ///
    /// # Errors
    ///
    /// The body is shorter or longer than the message, or a text in it is not UTF-8.
    fn decode(body: Bytes) -> Result<Self, DecodeError> {
        let mut from = Reader::new(body);
        let message = Self::read(&mut from)?;
        from.finish()?;
        Ok(message)
    }

    /// The message as it goes over the wire, without its length.
    fn encode(&self) -> Vec<u8> {
        let mut to = Vec::with_capacity(Self::LEAST);
        self.write(&mut to);
        to
    }
}

/// A message type as data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Description {
    /// `nav_msgs/Odometry`.
    pub name: &'static str,
    /// Its checksum.
    pub md5: &'static str,
    /// Its definition.
    pub definition: &'static str,
}

/// Describes `M`.
#[must_use]
pub const fn describe<M: Message>() -> Description {
    Description { name: M::TYPE, md5: M::MD5, definition: M::DEFINITION }
}

/// The message type of that name, among those that are known here.
#[must_use]
pub fn find(name: &str) -> Option<&'static Description> {
    crate::ALL.iter().find(|description| description.name == name)
}

/// A message type as it is told over the wire; not every one is known here.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Type {
    /// `nav_msgs/Odometry`.
    pub name: String,
    /// Its checksum.
    pub md5: String,
    /// Its definition.
    pub definition: String,
}

impl From<Description> for Type {
    fn from(description: Description) -> Self {
        Type {
            name: description.name.to_owned(),
            md5: description.md5.to_owned(),
            definition: description.definition.to_owned(),
        }
    }
}
