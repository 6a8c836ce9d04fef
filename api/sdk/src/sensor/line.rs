//! A connection: messages behind their lengths, and the descriptors of memory that come with them.

use std::collections::VecDeque;
use std::io;
use std::mem::MaybeUninit;
use std::os::fd::OwnedFd;
use std::ptr::NonNull;

use bytes::{Buf as _, BufMut as _, BytesMut};
use muster_api::wire::sensor::v1 as proto;
use prost::Message as _;
use rustix::mm::{MapFlags, ProtFlags};
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags};
use tokio::io::Interest;
use tokio::net::UnixStream;

/// Longest message: a frame that was sent, and what is around it.
const LONGEST: usize = (1 << 30) + (64 << 10);

/// What is read at once, bytes.
const CHUNK: usize = 64 << 10;

#[derive(Debug)]
pub(super) struct Line {
    stream: UnixStream,
    heard: BytesMut,
    /// Not yet written.
    said: BytesMut,
    descriptors: VecDeque<OwnedFd>,
}

impl Line {
    pub(super) fn new(stream: UnixStream) -> Line {
        Line { stream, heard: BytesMut::new(), said: BytesMut::new(), descriptors: VecDeque::new() }
    }

    /// Says it before anything else is heard.
    pub(super) fn say(&mut self, call: proto::call::Call) -> io::Result<()> {
        let call = proto::Call { call: Some(call) };
        self.said.put_u32(u32::try_from(call.encoded_len()).map_err(io::Error::other)?);
        call.encode(&mut self.said).map_err(io::Error::other)
    }

    /// The next message; none: the other side closed. Cancel safe.
    pub(super) async fn hear(&mut self) -> io::Result<Option<proto::Event>> {
        loop {
            while !self.said.is_empty() {
                self.stream.writable().await?;
                match self.stream.try_write(&self.said) {
                    Ok(written) => self.said.advance(written),
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                    // What was said before it closed is heard first.
                    Err(_) => self.said.clear(),
                }
            }
            if let Some(event) = self.whole()? {
                return Ok(Some(event));
            }
            if self.read().await? == 0 {
                return Ok(None);
            }
        }
    }

    /// The memory whose descriptor came with the message that was just heard.
    pub(super) fn map(&mut self, capacity: u64) -> io::Result<Mapping> {
        let descriptor = self.descriptors.pop_front();
        let missing =
            || io::Error::new(io::ErrorKind::InvalidData, "no descriptor came with a frame");
        Mapping::new(&descriptor.ok_or_else(missing)?, capacity)
    }

    fn whole(&mut self) -> io::Result<Option<proto::Event>> {
        let Some(length) = self.heard.first_chunk::<4>() else { return Ok(None) };
        let length = u32::from_be_bytes(*length) as usize;
        if length > LONGEST {
            return Err(io::Error::other(format!("a message of {length} bytes")));
        }
        if self.heard.len() < 4 + length {
            self.heard.reserve(4 + length - self.heard.len());
            return Ok(None);
        }
        self.heard.advance(4);
        let message = self.heard.split_to(length).freeze();
        proto::Event::decode(message).map(Some).map_err(io::Error::other)
    }

    async fn read(&mut self) -> io::Result<usize> {
        let Line { stream, heard, descriptors, .. } = self;
        let end = heard.len();
        heard.resize(heard.capacity().max(end + CHUNK), 0);
        let read = stream
            .async_io(Interest::READABLE, || {
                let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(4))];
                let mut control = RecvAncillaryBuffer::new(&mut space);
                let mut parts = [io::IoSliceMut::new(&mut heard[end..])];
                let got = rustix::net::recvmsg(
                    &*stream,
                    &mut parts,
                    &mut control,
                    RecvFlags::CMSG_CLOEXEC,
                )?;
                for message in control.drain() {
                    if let RecvAncillaryMessage::ScmRights(rights) = message {
                        descriptors.extend(rights);
                    }
                }
                Ok(got.bytes)
            })
            .await;
        heard.truncate(end + read.as_ref().copied().unwrap_or(0));
        read
    }
}

/// Memory that the agent writes and this program sees.
#[derive(Debug)]
pub(super) struct Mapping {
    at: NonNull<u8>,
    capacity: usize,
}

// SAFETY: memory that is only read from here.
unsafe impl Send for Mapping {}
// SAFETY: as above.
unsafe impl Sync for Mapping {}

impl Mapping {
    fn new(descriptor: &OwnedFd, capacity: u64) -> io::Result<Mapping> {
        let size = rustix::fs::fstat(descriptor)?.st_size;
        let capacity = usize::try_from(capacity).unwrap_or(usize::MAX);
        // Beyond its end there is no memory, and a program that looks there dies.
        if capacity == 0 || usize::try_from(size).is_ok_and(|size| size < capacity) {
            let text = format!("{capacity} bytes of a memory of {size}");
            return Err(io::Error::new(io::ErrorKind::InvalidData, text));
        }
        // SAFETY: a new mapping at a place of the kernel's choice.
        let at = unsafe {
            rustix::mm::mmap(
                std::ptr::null_mut(),
                capacity,
                ProtFlags::READ,
                MapFlags::SHARED,
                descriptor,
                0,
            )?
        };
        let at = NonNull::new(at.cast()).ok_or(io::ErrorKind::OutOfMemory)?;
        Ok(Mapping { at, capacity })
    }

    /// From its beginning, as far as it goes.
    pub(super) fn bytes(&self, length: u64) -> &[u8] {
        let length = usize::try_from(length).unwrap_or(usize::MAX).min(self.capacity);
        // SAFETY: the mapping is as long as its capacity, sealed against shrinking, and the agent does not write into it before
        // this program says that it is done.
        unsafe { std::slice::from_raw_parts(self.at.as_ptr(), length) }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: the mapping that was made with it; no reference into it outlives it.
        let _ = unsafe { rustix::mm::munmap(self.at.as_ptr().cast(), self.capacity) };
    }
}
