//! Logs: asked of the agent that has them, chunk by chunk through its session.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use futures::future::BoxFuture;
use futures::stream::{self, BoxStream, StreamExt as _};
use muster_api::kind::task::Task;
use muster_api::name::NodeName;
use muster_api::wire::agent::v1 as wire;
use tokio::sync::mpsc;

use super::{Connection, Sessions, lock};
use crate::context::Context;
use crate::objects;
use crate::rest::log::{LogError, LogOptions, LogSource};
use crate::store::Key;

/// Chunks that wait for a slow reader. An agent sends chunks of some kilobytes; when this is full the
/// reader is too slow and its log is cut, rather than holding up the agent's session.
const CHUNKS: usize = 256;

type Chunk = Result<Bytes, LogError>;

/// The logs that one session is reading.
#[derive(Debug, Default)]
pub(crate) struct Readers {
    next: AtomicU64,
    open: Mutex<HashMap<u64, mpsc::Sender<Chunk>>>,
}

impl Readers {
    fn begin(&self) -> (u64, mpsc::Receiver<Chunk>) {
        let id = self.next.fetch_add(1, Ordering::Relaxed) + 1;
        let (sender, receiver) = mpsc::channel(CHUNKS);
        lock(&self.open).insert(id, sender);
        (id, receiver)
    }

    fn end(&self, id: u64) -> bool {
        lock(&self.open).remove(&id).is_some()
    }

    /// Hands a chunk on. False: nobody reads this log any more, the agent may stop.
    pub(crate) fn take(&self, chunk: wire::LogChunk) -> bool {
        let Some(sender) = lock(&self.open).get(&chunk.id).cloned() else { return chunk.end };
        let mut delivered = true;
        if !chunk.data.is_empty() {
            delivered = sender.try_send(Ok(Bytes::from(chunk.data))).is_ok();
        }
        if !chunk.error.is_empty() {
            // A full or closed queue ends the log as well.
            drop(sender.try_send(Err(LogError::Broken(chunk.error))));
        }
        if chunk.end || !delivered {
            self.end(chunk.id);
        }
        delivered || chunk.end
    }
}

/// Ends the reading at the agent when its reader goes away.
struct Reading {
    connection: Connection,
    id: u64,
}

impl Drop for Reading {
    fn drop(&mut self) {
        if self.connection.logs.end(self.id) {
            let body = wire::controller_message::Body::LogCancel(wire::LogCancel { id: self.id });
            // A full queue: the agent's next chunk finds no reader and is answered with a cancel.
            drop(self.connection.outbound.try_send(wire::ControllerMessage { body: Some(body) }));
        }
    }
}

/// Opens logs through the sessions.
#[derive(Debug)]
pub(crate) struct SessionLogs {
    pub(crate) context: std::sync::Weak<Context>,
    pub(crate) sessions: Arc<Sessions>,
}

impl LogSource for SessionLogs {
    fn open(
        &self,
        task: Key,
        options: LogOptions,
    ) -> BoxFuture<'_, Result<BoxStream<'static, Chunk>, LogError>> {
        Box::pin(self.open_log(task, options))
    }
}

impl SessionLogs {
    async fn open_log(
        &self,
        key: Key,
        options: LogOptions,
    ) -> Result<BoxStream<'static, Chunk>, LogError> {
        let ends = || LogError::Broken("the controller ends".to_owned());
        let context = self.context.upgrade().ok_or_else(ends)?;
        let stored = context
            .store
            .get(&key)
            .ok_or_else(|| LogError::Nothing("the task is gone".to_owned()))?;
        let task: Task = objects::read(&stored)
            .ok_or_else(|| LogError::Nothing("the task cannot be read".to_owned()))?;
        let node = task.status.and_then(|s| s.node);
        let node =
            node.ok_or_else(|| LogError::Nothing("the task has not been placed yet".to_owned()))?;
        let unreachable = || LogError::Unreachable { node: node.clone() };
        let name = NodeName::new(node.clone()).map_err(|_| unreachable())?;
        let connection = self.sessions.connection(&name).ok_or_else(unreachable)?;
        let (id, receiver) = connection.logs.begin();
        let request = wire::LogRequest {
            id,
            uid: stored.uid.to_string(),
            follow: options.follow,
            previous: options.previous,
            tail_lines: options.tail_lines,
            timestamps: options.timestamps,
            since: options.since.map(prost_time),
        };
        let message =
            wire::ControllerMessage { body: Some(wire::controller_message::Body::Log(request)) };
        let reading = Reading { connection: connection.clone(), id };
        connection.outbound.send(message).await.map_err(|_| unreachable())?;
        let chunks = stream::unfold((receiver, reading), |(mut receiver, reading)| async move {
            let chunk = receiver.recv().await?;
            Some((chunk, (receiver, reading)))
        });
        Ok(chunks.boxed())
    }
}

fn prost_time(at: jiff::Timestamp) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: at.as_second(), nanos: at.subsec_nanosecond() }
}
