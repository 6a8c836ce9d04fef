//! Frames: a big-endian 32-bit length, then one protobuf message.

use std::io;

use bytes::{BufMut as _, BytesMut};
use muster_api::wire::Rope;
use prost::Message;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};

/// Longest message of a framework or an executor, bytes.
pub(crate) const MESSAGE_MAX: usize = muster_api::direct::MESSAGE_MAX;

/// Longest frame: the longest message, and what is around it. Also the link's.
pub(crate) const FRAME_MAX: usize = MESSAGE_MAX + (64 << 10);

/// `None`: the other side closed. Not cancel-safe.
pub(crate) async fn read<M, R>(from: &mut R) -> io::Result<Option<M>>
where
    M: Message + Default,
    R: AsyncRead + Unpin,
{
    read_within(FRAME_MAX, from).await
}

/// The same for frames of at most `longest` bytes.
pub(crate) async fn read_within<M, R>(longest: usize, from: &mut R) -> io::Result<Option<M>>
where
    M: Message + Default,
    R: AsyncRead + Unpin,
{
    let length = match from.read_u32().await {
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => return Ok(None),
        length => usize::try_from(length?).unwrap_or(usize::MAX),
    };
    let invalid = |text: String| io::Error::new(io::ErrorKind::InvalidData, text);
    if length > longest {
        return Err(invalid(format!("a frame of {length} bytes; the longest is {longest}")));
    }
    let mut bytes = BytesMut::with_capacity(length);
    while bytes.len() < length {
        let left = length - bytes.len();
        if from.read_buf(&mut (&mut bytes).limit(left)).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
    }
    M::decode(bytes.freeze()).map(Some).map_err(|error| invalid(error.to_string()))
}

/// Not cancel-safe.
pub(crate) async fn write<M, W>(to: &mut W, message: &M) -> io::Result<()>
where
    M: Message,
    W: AsyncWrite + Unpin,
{
    let length = u32::try_from(message.encoded_len()).map_err(io::Error::other)?;
    let mut frame = Rope::new();
    frame.put_u32(length);
    message.encode(&mut frame).map_err(io::Error::other)?;
    frame.seal();
    to.write_all_buf(&mut frame).await
}

#[cfg(test)]
mod tests {
    use muster_api::wire::executor::v1 as proto;

    use super::*;

    #[tokio::test]
    async fn there_and_back_and_too_long() {
        let message = proto::Message { data: vec![7; 1_000].into() };
        let mut bytes = Vec::new();
        write(&mut bytes, &message).await.unwrap();
        let mut from = bytes.as_slice();
        assert_eq!(read(&mut from).await.unwrap(), Some(message));
        assert_eq!(read::<proto::Message, _>(&mut from).await.unwrap(), None);
        let mut long = &[0xff_u8; 8][..];
        assert!(read::<proto::Message, _>(&mut long).await.is_err());
        let mut cut = &bytes[..100];
        assert!(read::<proto::Message, _>(&mut cut).await.is_err());
    }
}
