//! TCPROS: a header of `key=value` fields each way, then messages with their lengths (wiki.ros.org/ROS/TCPROS).

use std::io;

use bytes::{Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt as _};

/// A header with the longest message definition that is seen is a tenth of it.
pub const LARGEST_HEADER: usize = 256 << 10;
/// The largest message that is taken unless somebody says otherwise: an uncompressed 8K image.
pub const LARGEST_FRAME: usize = 128 << 20;
/// Memory that is taken on the word of a length alone. More is taken when that much has come.
const ON_TRUST: usize = 1 << 20;

/// A connection header.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Header(Vec<(String, String)>);

/// Why bytes are no header.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum HeaderError {
    /// A field is longer than the rest.
    #[error("a field of the connection header is longer than the header")]
    Short,
    /// A field has no `=`, or is not UTF-8.
    #[error("a field of the connection header is not KEY=VALUE")]
    Field,
}

impl Header {
    /// Of fields, in this order.
    #[must_use]
    pub fn new<'a>(fields: impl IntoIterator<Item = (&'a str, &'a str)>) -> Self {
        Header(fields.into_iter().map(|(key, value)| (key.to_owned(), value.to_owned())).collect())
    }

    /// A field's value.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&str> {
        self.0.iter().find(|(k, _)| k == key).map(|(_, value)| value.as_str())
    }

    /// As it goes over the wire, its length first.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut out = vec![0; 4];
        for (key, value) in &self.0 {
            out.extend_from_slice(&length(key.len() + 1 + value.len()));
            out.extend_from_slice(key.as_bytes());
            out.push(b'=');
            out.extend_from_slice(value.as_bytes());
        }
        let whole = length(out.len() - 4);
        out[..4].copy_from_slice(&whole);
        out
    }

    /// Without its length.
    ///
    /// # Errors
    ///
    /// The bytes are no header.
    pub fn decode(mut rest: &[u8]) -> Result<Self, HeaderError> {
        let mut fields = Vec::new();
        while !rest.is_empty() {
            let (size, after) = rest.split_first_chunk::<4>().ok_or(HeaderError::Short)?;
            let size = u32::from_le_bytes(*size) as usize;
            let (field, after) = after.split_at_checked(size).ok_or(HeaderError::Short)?;
            rest = after;
            // Publishers of C++ put whatever encoding into definitions; that field is not needed.
            let field = String::from_utf8_lossy(field);
            let (key, value) = field.split_once('=').ok_or(HeaderError::Field)?;
            fields.push((key.to_owned(), value.to_owned()));
        }
        Ok(Header(fields))
    }
}

/// As it stands before a message or a field.
pub(crate) fn length(of: usize) -> [u8; 4] {
    u32::try_from(of).expect("nothing of 4 GiB is sent").to_le_bytes()
}

/// Why reading ended.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The connection broke.
    #[error("the connection broke")]
    Io(#[from] io::Error),
    /// The other side announces more than is taken.
    #[error("it announces {size} bytes; at most {limit} are taken")]
    TooLarge {
        /// What it announces.
        size: usize,
        /// What is taken.
        limit: usize,
    },
}

/// Reads a length and so many bytes. Not cancel safe.
///
/// # Errors
///
/// The connection breaks, or more is announced than `limit`.
pub async fn read_frame(
    from: &mut (impl AsyncRead + Unpin),
    limit: usize,
) -> Result<Bytes, ReadError> {
    let size = from.read_u32_le().await? as usize;
    if size > limit {
        return Err(ReadError::TooLarge { size, limit });
    }
    let mut frame = BytesMut::with_capacity(size.min(ON_TRUST));
    let mut rest = from.take(size as u64);
    while frame.len() < size {
        if frame.len() == frame.capacity() {
            // Doubling: a frame that comes whole is copied a few times at most.
            frame.reserve(frame.len().min(size - frame.len()));
        }
        if rest.read_buf(&mut frame).await? == 0 {
            return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into());
        }
    }
    Ok(frame.freeze())
}

/// Reads a length and passes over so many bytes; how many. Not cancel safe.
///
/// # Errors
///
/// As [`read_frame`].
pub async fn skip_frame(
    from: &mut (impl AsyncRead + Unpin),
    limit: usize,
) -> Result<usize, ReadError> {
    let size = from.read_u32_le().await? as usize;
    if size > limit {
        return Err(ReadError::TooLarge { size, limit });
    }
    let mut rest = from.take(size as u64);
    let passed = tokio::io::copy(&mut rest, &mut tokio::io::sink()).await?;
    if passed < size as u64 {
        return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into());
    }
    Ok(size)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn headers_come_as_they_went(fields in prop::collection::vec(("[a-z_0-9]{1,8}", "[ -~\\n]{0,40}"), 0..6)) {
            let header = Header::new(fields.iter().map(|(k, v)| (&**k, &**v)));
            prop_assert_eq!(Header::decode(&header.encode()[4..]), Ok(header));
        }

        #[test]
        fn any_bytes_are_a_header_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..100)) {
            drop(Header::decode(&bytes));
        }
    }

    #[tokio::test]
    async fn a_frame_is_read_whole_however_it_comes() {
        let (mut there, mut here) = tokio::io::duplex(1000);
        let body: Vec<u8> = (0..3 * ON_TRUST).map(|n| (n % 251) as u8).collect();
        let sent = body.clone();
        let write = async move {
            use tokio::io::AsyncWriteExt as _;
            there.write_all(&length(sent.len())).await.unwrap();
            there.write_all(&sent).await.unwrap();
            there.write_all(&length(3)).await.unwrap();
            there.write_all(b"abc").await.unwrap();
            there.write_all(&length(4)).await.unwrap();
        };
        let read = async {
            assert_eq!(read_frame(&mut here, LARGEST_FRAME).await.unwrap(), body);
            assert_eq!(skip_frame(&mut here, LARGEST_FRAME).await.unwrap(), 3);
            let cut = read_frame(&mut here, LARGEST_FRAME).await;
            assert!(matches!(cut, Err(ReadError::Io(_))), "the other side is gone within a frame");
        };
        tokio::join!(write, read);
    }

    #[tokio::test]
    async fn more_than_is_taken_is_refused_before_it_is_read() {
        let mut hostile: &[u8] = &u32::MAX.to_le_bytes();
        let refused = read_frame(&mut hostile, 100).await;
        assert!(matches!(refused, Err(ReadError::TooLarge { limit: 100, .. })));
    }
}
