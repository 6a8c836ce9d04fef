//! Frames: a header of 16 bytes, then the payload as it is. Big-endian, like every number on a wire of ours.
//!
//! ```text
//!   0      1        4          8                16
//!   | kind | zeroes | length   | number         | payload
//! ```

use super::{Line, MESSAGE_MAX, SECRET_BYTES, Secret};

/// Bytes before a payload.
pub const HEADER: usize = 16;

/// Longest uid of an executor in a Hello, bytes. Uids are UUIDs.
const UID_MAX: usize = 64;

/// What a frame is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The framework shows its ticket; the number is the line's. First frame of a connection, and only there.
    Hello,
    /// The ticket is good.
    Welcome,
    /// A message. From a framework its number grows, and is given back in [`Kind::Taken`] or [`Kind::Refused`].
    Message,
    /// The message of this number is on its way to the executor.
    Taken,
    /// The message of this number is dropped: the executor is not there, or does not keep up.
    Refused,
    /// The other side's mark has come through the controller; the number is the line's.
    Passed,
}

/// What precedes a payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// What it is.
    pub kind: Kind,
    /// Bytes that follow.
    pub length: usize,
    /// What the kind says.
    pub number: u64,
}

/// Why bytes are no frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// A kind that this side does not know.
    #[error("a frame of an unknown kind, {0}")]
    Kind(u8),
    /// More than its kind may have.
    #[error("a frame of {0} bytes, which is too long")]
    Length(usize),
    /// A Hello without what belongs into it.
    #[error("a Hello that cannot be read")]
    Hello,
}

impl Header {
    /// A frame that is all header.
    #[must_use]
    pub fn bare(kind: Kind, number: u64) -> Header {
        Header { kind, length: 0, number }
    }

    /// As it travels.
    ///
    /// # Panics
    ///
    /// When a payload is longer than 4 GiB; the longest message is 4 MiB.
    #[must_use]
    pub fn encode(self) -> [u8; HEADER] {
        let kind = match self.kind {
            Kind::Hello => 1,
            Kind::Welcome => 2,
            Kind::Message => 3,
            Kind::Taken => 4,
            Kind::Refused => 5,
            Kind::Passed => 6,
        };
        let length = u32::try_from(self.length).expect("payloads are shorter than MESSAGE_MAX");
        let mut bytes = [0; HEADER];
        bytes[0] = kind;
        bytes[4..8].copy_from_slice(&length.to_be_bytes());
        bytes[8..].copy_from_slice(&self.number.to_be_bytes());
        bytes
    }

    /// Reads one.
    ///
    /// # Errors
    ///
    /// When the kind is not known, or its payload would be longer than that kind's may be: nothing of it is read then.
    pub fn decode(bytes: [u8; HEADER]) -> Result<Header, FrameError> {
        let (kind, longest) = match bytes[0] {
            1 => (Kind::Hello, SECRET_BYTES + UID_MAX),
            2 => (Kind::Welcome, 0),
            3 => (Kind::Message, MESSAGE_MAX),
            4 => (Kind::Taken, 0),
            5 => (Kind::Refused, 0),
            6 => (Kind::Passed, 0),
            other => return Err(FrameError::Kind(other)),
        };
        let [_, _, _, _, l0, l1, l2, l3, number @ ..] = bytes;
        let length = u32::from_be_bytes([l0, l1, l2, l3]) as usize;
        if length > longest {
            return Err(FrameError::Length(length));
        }
        Ok(Header { kind, length, number: u64::from_be_bytes(number) })
    }
}

/// What the first frame says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Hello {
    /// The connection's number.
    pub line: Line,
    /// Uid of the executor's task.
    pub executor: String,
    /// The ticket.
    pub secret: Secret,
}

impl Hello {
    /// The whole frame.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let length = SECRET_BYTES + self.executor.len();
        let header = Header { kind: Kind::Hello, length, number: self.line.number() };
        [&header.encode(), &self.secret.bytes()[..], self.executor.as_bytes()].concat()
    }

    /// Reads its payload.
    ///
    /// # Errors
    ///
    /// When something of it is missing.
    pub fn decode(header: Header, payload: &[u8]) -> Result<Hello, FrameError> {
        let read = || {
            let (secret, executor) = payload.split_at_checked(SECRET_BYTES)?;
            let executor = std::str::from_utf8(executor).ok().filter(|uid| !uid.is_empty())?;
            let line = Line::new(header.number).filter(|_| header.kind == Kind::Hello)?;
            Some(Hello { line, executor: executor.to_owned(), secret: Secret::read(secret)? })
        };
        read().ok_or(FrameError::Hello)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_travel_and_too_much_is_refused() {
        use Kind::{Hello, Message, Passed, Refused, Taken, Welcome};
        for kind in [Hello, Welcome, Message, Taken, Refused, Passed] {
            let header = Header::bare(kind, u64::MAX - 1);
            assert_eq!(Header::decode(header.encode()), Ok(header));
        }
        let longest = Header { kind: Message, length: MESSAGE_MAX, number: 7 };
        assert_eq!(Header::decode(longest.encode()), Ok(longest));
        for (kind, length) in [(Message, MESSAGE_MAX + 1), (Taken, 1), (Hello, 97)] {
            let long = Header { kind, length, number: 7 };
            assert_eq!(Header::decode(long.encode()), Err(FrameError::Length(length)));
        }
        for kind in [0, 7, 255] {
            let mut bytes = longest.encode();
            bytes[0] = kind;
            assert_eq!(Header::decode(bytes), Err(FrameError::Kind(kind)));
        }
    }

    #[test]
    fn a_hello_travels_whole_or_not_at_all() {
        let line = Line::new(9).expect("not 0");
        let secret = Secret::new([3; SECRET_BYTES]);
        let hello = Hello { line, executor: "e-1".to_owned(), secret };
        let bytes = hello.encode();
        let (header, payload) = bytes.split_first_chunk().expect("a header");
        let header = Header::decode(*header).expect("a frame");
        assert_eq!(header.length, payload.len());
        assert_eq!(Hello::decode(header, payload), Ok(hello));
        for bad in [&payload[..SECRET_BYTES], &payload[..5], &[0xff; 40], &[]] {
            assert_eq!(Hello::decode(header, bad), Err(FrameError::Hello));
        }
        let no_line = Header { number: 0, ..header };
        assert_eq!(Hello::decode(no_line, payload), Err(FrameError::Hello));
    }
}
