//! Messages behind their lengths: a big-endian 32-bit length, then one message.

use std::io;

use bytes::{Buf as _, BufMut as _, BytesMut};
use muster_api::wire::Rope;
use prost::Message;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};

/// Largest frame: a message of 4 MiB and what is around it.
const MAX_FRAME: usize = (4 << 20) + (64 << 10);

/// Reads frames; what was read of a frame is kept here, so that reading can be given up at any time.
#[derive(Debug)]
pub(crate) struct Frames<R> {
    from: R,
    buffer: BytesMut,
}

impl<R: AsyncRead + Unpin> Frames<R> {
    pub(crate) fn new(from: R) -> Self {
        Frames { from, buffer: BytesMut::new() }
    }

    /// The next message; none: the other side closed. Cancel-safe.
    pub(crate) async fn next<M: Message + Default>(&mut self) -> io::Result<Option<M>> {
        loop {
            if let Some(frame) = self.whole()? {
                return M::decode(frame).map(Some).map_err(io::Error::other);
            }
            if self.from.read_buf(&mut self.buffer).await? == 0 {
                return Ok(None);
            }
        }
    }

    fn whole(&mut self) -> io::Result<Option<bytes::Bytes>> {
        let Some(length) = self.buffer.first_chunk::<4>() else { return Ok(None) };
        let length = u32::from_be_bytes(*length) as usize;
        if length > MAX_FRAME {
            return Err(io::Error::other(format!("a frame of {length} bytes is too long")));
        }
        if self.buffer.len() < 4 + length {
            self.buffer.reserve(4 + length - self.buffer.len());
            return Ok(None);
        }
        self.buffer.advance(4);
        Ok(Some(self.buffer.split_to(length).freeze()))
    }
}

/// Writes one frame.
pub(crate) async fn write<W: AsyncWrite + Unpin>(
    to: &mut W,
    message: &impl Message,
) -> io::Result<()> {
    let length = message.encoded_len();
    let prefix = u32::try_from(length).ok().filter(|_| length <= MAX_FRAME);
    let prefix =
        prefix.ok_or_else(|| io::Error::other(format!("{length} bytes are too long a frame")))?;
    let mut frame = Rope::new();
    frame.put_u32(prefix);
    message.encode(&mut frame).map_err(io::Error::other)?;
    frame.seal();
    to.write_all_buf(&mut frame).await
}
