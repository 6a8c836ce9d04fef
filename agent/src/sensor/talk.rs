//! One reader's connection: who it is, then frames as it can take them.

use std::collections::BTreeSet;
use std::io;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::time::Duration;

use muster_agent_core::sensor::fan::{DEEPEST, Delivery};
use muster_agent_core::sensor::source::Standing;
use muster_api::secret::same;
use muster_api::wire::sensor::v1 as proto;
use prost::Message as _;
use proto::call::Call as Said;
use proto::event::Event as Say;
use proto::frame::Body as Sent;
use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags};
use tokio::io::Interest;
use tokio::net::UnixStream;
use tokio::net::unix::WriteHalf;

use super::channel::{Body, Channel, Frame, Stand, Subscription};
use crate::executor::frame;
use crate::runtime::{AttemptId, Runtime};

/// The protocol that this agent speaks.
const VERSION: u32 = 1;

/// Who connects says what it wants within this, and is found among the task's processes.
const SHOW_WITHIN: Duration = Duration::from_secs(5);

/// Between two looks for an attempt that was just started, or that this life of the agent has not found yet.
const LOOK: Duration = Duration::from_millis(20);

/// Whoever is put out while it does not read is not told for longer.
const TOLD_WITHIN: Duration = Duration::from_secs(1);

/// Longest frame of a task, bytes.
const LONGEST_CALL: usize = 4 << 10;

/// Whose a socket is.
#[derive(Debug)]
pub(crate) struct Owner {
    pub(crate) runtime: Arc<dyn Runtime>,
    pub(crate) id: AttemptId,
    pub(crate) token: String,
}

/// A socket of a task.
#[derive(Debug)]
pub(super) struct Door {
    pub(super) channel: Arc<Channel>,
    pub(super) owner: Arc<Owner>,
    /// Of the agent.
    pub(super) life: String,
}

pub(super) async fn talk(mut stream: UnixStream, door: Arc<Door>) {
    let (id, function) = (&door.owner.id, door.channel.function());
    let greeted = tokio::time::timeout(SHOW_WITHIN, greet(&mut stream, &door)).await;
    let open = match greeted.unwrap_or_else(|_| Err(refused("nobody of the task said anything"))) {
        Ok(open) => open,
        Err(closed) => {
            tracing::warn!(%id, %function, why = closed.message, "a reader is refused");
            let told = say(&mut stream, Say::Closed(closed));
            let _ = tokio::time::timeout(TOLD_WITHIN, told).await;
            return;
        }
    };
    let depth = usize::try_from(open.queue).unwrap_or(DEEPEST);
    let subscription = door.channel.subscribe(depth);
    if let Err(error) = serve(&mut stream, &door, &subscription, open.inline).await {
        tracing::debug!(%id, %function, %error, "a reader's connection");
    }
}

fn refused(message: &str) -> proto::Closed {
    proto::Closed { reason: proto::Reason::Refused.into(), message: message.to_owned() }
}

async fn greet(stream: &mut UnixStream, door: &Door) -> Result<proto::Open, proto::Closed> {
    let closed =
        |reason: proto::Reason, message: String| proto::Closed { reason: reason.into(), message };
    let peer = stream.peer_cred().ok().and_then(|peer| peer.pid());
    let first = frame::read_within(LONGEST_CALL, stream).await;
    let Ok(Some(proto::Call { call: Some(Said::Open(open)) })) = first else {
        return Err(closed(proto::Reason::Protocol, "the first message is no Open".to_owned()));
    };
    if open.version != VERSION {
        let message = format!("version {} is not spoken here; {VERSION} is", open.version);
        return Err(closed(proto::Reason::Unsupported, message));
    }
    let owner = &door.owner;
    if !same(open.token.as_bytes(), owner.token.as_bytes()) {
        return Err(refused("it does not have the task's token"));
    }
    let Some(pid) = peer.filter(|pid| *pid > 0) else {
        return Err(refused("the kernel does not name it to the agent"));
    };
    // The whole of it ends with the time for greetings.
    loop {
        match owner.runtime.has(&owner.id, pid) {
            Some(true) => return Ok(open),
            Some(false) => return Err(refused("it is no process of the task")),
            None => tokio::time::sleep(LOOK).await,
        }
    }
}

async fn say<W: tokio::io::AsyncWrite + Unpin>(to: &mut W, event: Say) -> io::Result<()> {
    frame::write(to, &proto::Event { event: Some(event) }).await
}

async fn serve(
    stream: &mut UnixStream,
    door: &Door,
    subscription: &Subscription,
    inline: bool,
) -> io::Result<()> {
    let (mut from, to) = stream.split();
    let read = async {
        while let Some(call) = frame::read_within::<proto::Call, _>(LONGEST_CALL, &mut from).await?
        {
            match call.call {
                Some(Said::Done(done)) => {
                    if let Err(error) = subscription.done(done.sequence) {
                        subscription.refuse(&error.to_string());
                    }
                }
                Some(Said::Open(_)) => subscription.refuse("it is open already"),
                // Something newer than this agent, which it does without.
                None => {}
            }
        }
        Ok(())
    };
    let mut writer = Writer { to, inline, slots: BTreeSet::new() };
    let write = writer.run(door, subscription);
    // Whoever is put out while it does not read would keep its frame.
    let stuck = async {
        subscription.closed().await;
        tokio::time::sleep(TOLD_WITHIN).await;
        Ok(())
    };
    // None is polled again after another has ended.
    tokio::select! {
        ended = read => ended,
        ended = write => ended,
        ended = stuck => ended,
    }
}

struct Writer<'a> {
    to: WriteHalf<'a>,
    /// It takes no shared memory.
    inline: bool,
    /// Those that it has seen.
    slots: BTreeSet<u32>,
}

impl Writer<'_> {
    async fn run(&mut self, door: &Door, subscription: &Subscription) -> io::Result<()> {
        let function = door.channel.function().to_string();
        say(&mut self.to, Say::Opened(proto::Opened { function, life: door.life.clone() })).await?;
        let mut stand = door.channel.stand();
        stand.mark_changed();
        loop {
            // Cancel-safe: a watch, and a line that gives when it is asked.
            let next = tokio::select! {
                // Closed: the agent ends.
                changed = stand.changed() => {
                    changed.map_err(io::Error::other)?;
                    stand.mark_changed();
                    None
                }
                next = subscription.next() => Some(next),
            };
            // What was said of the source before a frame came is told before it: the format, say.
            if stand.has_changed().map_err(io::Error::other)? {
                let now = source(&stand.borrow_and_update());
                say(&mut self.to, Say::Source(now)).await?;
            }
            match next {
                None => {}
                Some(Ok(delivery)) => self.deliver(delivery, subscription).await?,
                Some(Err(closed)) => return say(&mut self.to, Say::Closed(closed)).await,
            }
        }
    }

    async fn deliver(
        &mut self,
        next: Delivery<Frame>,
        subscription: &Subscription,
    ) -> io::Result<()> {
        let Delivery { sequence, dropped, frame: Frame { stamp_ns, boot_ns, body } } = next;
        let frame = |body| {
            let body = Some(body);
            Say::Frame(proto::Frame { sequence, dropped, stamp_ns, boot_ns, body })
        };
        let (slot, length) = match body {
            Body::Inline(bytes) => return say(&mut self.to, frame(Sent::Data(bytes))).await,
            Body::Shared { slot, length } if self.inline => {
                let bytes = bytes::Bytes::copy_from_slice(slot.bytes(length));
                return say(&mut self.to, frame(Sent::Data(bytes))).await;
            }
            Body::Shared { slot, length } => (slot, length),
        };
        let attached = self.slots.insert(slot.id());
        let retired = match attached {
            true => subscription.retired(self.slots.iter().copied()),
            false => Vec::new(),
        };
        self.slots.retain(|slot| !retired.contains(slot));
        let shared = proto::Shared {
            slot: slot.id(),
            length: length as u64,
            capacity: slot.capacity() as u64,
            attached,
            retired,
        };
        let event = proto::Event { event: Some(frame(Sent::Shared(shared))) };
        let descriptor = attached.then(|| slot.descriptor());
        send(self.to.as_ref(), &length_delimited(&event)?, descriptor).await
    }
}

fn length_delimited(event: &proto::Event) -> io::Result<Vec<u8>> {
    let length = u32::try_from(event.encoded_len()).map_err(io::Error::other)?;
    let mut bytes = length.to_be_bytes().to_vec();
    event.encode(&mut bytes).map_err(io::Error::other)?;
    Ok(bytes)
}

/// Writes all of `bytes`, and the descriptor with the first of them.
async fn send(
    to: &UnixStream,
    mut bytes: &[u8],
    mut descriptor: Option<BorrowedFd<'_>>,
) -> io::Result<()> {
    while !bytes.is_empty() {
        let sent = to
            .async_io(Interest::WRITABLE, || {
                let mut space =
                    [std::mem::MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
                let mut control = SendAncillaryBuffer::new(&mut space);
                let descriptors: Vec<BorrowedFd<'_>> = descriptor.into_iter().collect();
                if !descriptors.is_empty() {
                    control.push(SendAncillaryMessage::ScmRights(&descriptors));
                }
                let parts = [io::IoSlice::new(bytes)];
                Ok(rustix::net::sendmsg(to, &parts, &mut control, SendFlags::NOSIGNAL)?)
            })
            .await?;
        descriptor = None;
        bytes = &bytes[sent..];
    }
    Ok(())
}

fn source(stand: &Stand) -> proto::Source {
    let (state, why) = match &stand.standing {
        Standing::Idle | Standing::Starting => (proto::State::Starting, String::new()),
        Standing::Delivering => (proto::State::Delivering, String::new()),
        Standing::Failing(why) => (proto::State::Failing, why.clone()),
    };
    proto::Source { state: state.into(), why, format: stand.format.clone() }
}
